"""Settings and methods as the YAML files have them: a test names only what it is about."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from hydra.utils import get_method
from omegaconf import DictConfig, OmegaConf

import sweeps

CONFIGS = Path(sweeps.__file__).with_name("configs")


def usual(files: str, part: str | None = None, **given: Any) -> Any:
    """What the `files` of a configuration, of which the last has the last word, make of their
    `part`, or as a whole, with what is `given` instead."""
    whole = OmegaConf.merge(*(OmegaConf.load(CONFIGS / f"{file}.yaml") for file in files.split()))
    return _made(whole if part is None else whole[part], given)


def _made(config: DictConfig, given: dict[str, Any]) -> Any:
    names = [name for name in config if name not in ("defaults", "_target_", *given)]
    values = {name: config[name] for name in names}
    for name, value in values.items():
        if isinstance(value, DictConfig):
            values[name] = _made(value, {})
    return get_method(config._target_)(**values, **given)


WHERE = {"backend": "auto", "device": "auto", "seed": 0}
new_ngp = partial(usual, "field/hash method/ngp", **WHERE)
new_gaussians = partial(usual, "field/hash method/gaussians", **WHERE)
field_options = partial(usual, "field/hash", "training")


def lessons(student: str, **given: Any) -> Any:
    """How a student is trained."""
    return usual(f"method/{student}", "training", **given)
