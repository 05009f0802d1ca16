"""What Hydra tells of a sweep before its first job, in the process that began it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from omegaconf import DictConfig


class Announced(Callback):
    """The sweep that is under way; run.yaml names it among Hydra's callbacks.

    Hydra makes the object itself and hands it to nobody, so what it hears is kept on the class.

    Attributes:
        folder: where the jobs leave how they ended; None where there is no sweep.
        sizes: how many values each override takes in turn.
    """

    folder: ClassVar[Path | None] = None
    sizes: ClassVar[dict[str, int]] = {}

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Keep where the sweep lies and how large it is."""
        Announced.folder = Path(config.hydra.sweep.dir)
        Announced.sizes = _sizes(config)


def _sizes(config: DictConfig) -> dict[str, int]:
    """How many values every override takes: those of the configuration, then those typed."""
    params = config.hydra.sweeper.get("params") or {}
    lines = [f"{name}={values}" for name, values in params.items()]
    parser = OverridesParser.create(GlobalHydra.instance().config_loader())
    return {
        override.get_key_element(): len(list(override.sweep_string_iterator()))
        if override.is_discrete_sweep()
        else 1
        for override in parser.parse_overrides([*lines, *config.hydra.overrides.task])
    }
