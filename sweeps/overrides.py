"""The configuration that the words of a command describe, and errors that quote these words.

Words are overrides as `steerbench run` takes them (scene=wires), and `--config-dir=DIR` for a
folder with further choices.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from sweeps import plug_ins
from sweeps.names import unknown

CONFIGS = Path(__file__).parent / "configs"
FLAGS = ("--config-dir", "-cd")

VALIDATION = "validation"
"""The split of training pictures that are held out, and the trajectory that goes to them."""


def composed(words: Sequence[str], **options: bool) -> DictConfig:
    """The configuration of a run; `options` as of Hydra's `compose`.

    Raises:
        SteerbenchError: a setting or a choice does not exist, or cannot be read.
    """
    overrides = _overrides(words)
    if further := [str(folder).replace("'", r"\'") for folder in _typed(words)]:
        paths = ",".join(f"'file://{folder}'" for folder in further)
        overrides.append(f"hydra.searchpath=[{paths}]")
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return settled(compose("run", overrides=overrides, **options))
    except Exception as error:
        if not of_hydra(error):
            raise
        raise explain(error, words) from error


def settled(config: DictConfig) -> DictConfig:
    """`config` with the trajectory that split=validation asks for, unless its own goes there.

    From here on the trajectory alone says what is scored, and with that what is held out.
    """
    asked, there = (OmegaConf.select(config, name) for name in ("split", "trajectory.split"))
    if asked == VALIDATION and there != VALIDATION:
        node = OmegaConf.load(CONFIGS / "trajectory" / f"{VALIDATION}.yaml")
        OmegaConf.update(config, "trajectory", node, merge=False, force_add=True)
    return config


def changed(config: DictConfig, words: Sequence[str]) -> DictConfig:
    """A copy of `config` with other values, read as Hydra reads them: composing anew is slower."""
    copy = config.copy()
    for override in OverridesParser.create().parse_overrides(list(words)):
        OmegaConf.update(copy, override.get_key_element(), override.value())
    return copy


def choices(group: str, words: Sequence[str] = ()) -> dict[str, Path]:
    """The file of every choice of `group` by its name, also of the folders that `words` name."""
    found = {
        path.stem: path
        for folder in reversed(_folders(words))  # of one name, the first folder has the choice
        for path in (folder / group).glob("*.yaml")
    }
    return dict(sorted(found.items()))


def setting(name: str, text: str) -> str:
    """The word that sets `name` to `text`, quoted where Hydra would read something else."""
    if re.fullmatch(r"[\w/.+-]+", text):
        return f"{name}={text}"
    escaped = text.replace("'", r"\'")
    return f"{name}='{escaped}'"


def of_hydra(error: Exception) -> bool:
    """Whether Hydra raised it: for some mistakes (budget=0.0) it raises no exception of its own,
    but a ValueError or what its parser stumbled over."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return innermost.f_globals["__name__"].partition(".")[0] in ("hydra", "omegaconf", "antlr4")


def swept(words: Sequence[str], loader: ConfigLoader | None = None) -> dict[str, list[str]]:
    """The values of every setting that has several (seed=0,1,2); the last word for it counts.

    Args:
        loader: Hydra's, where a choice may be a pattern (method=*).

    Raises:
        SteerbenchError: a word cannot be read.
    """
    try:
        parsed = OverridesParser.create(loader).parse_overrides(_overrides(words))
    except Exception as error:
        if not of_hydra(error):
            raise
        raise explain(error, words) from error
    values = {
        override.get_key_element(): list(override.sweep_string_iterator())
        if override.is_discrete_sweep()
        else []
        for override in parsed
    }
    return {name: several for name, several in values.items() if several}


def explain(error: Exception, words: Sequence[str]) -> SteerbenchError:
    """Translate an error of Hydra's; names that do not exist come with the nearest that do."""
    if isinstance(error, OverrideParseException):
        return SteerbenchError(
            f"cannot read '{error.override}': settings are written key=value, "
            f"for example seed=1 or scene=wires ({error.message.splitlines()[0]})"
        )
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return unknown(group, name, error.options)
    if key := re.match(r"Could not override '([^']+)'", str(error)):
        if (CONFIGS / key[1]).is_dir():
            return SteerbenchError(
                f"{key[1]}: each method brings its own, and takes no other; choose a method"
            )
        return unknown("setting", key[1], _settings(words))
    causes = [error, error.__cause__] if error.__cause__ else [error]
    lines = [line.strip() for cause in causes for line in str(cause).splitlines()]
    return SteerbenchError("; ".join(line for line in lines if line))


def _settings(words: Sequence[str]) -> list[str]:
    """All that can be set with the choices (scene=blender) in `words`."""
    folders = _folders(words)
    groups = {path.name for folder in folders for path in folder.iterdir() if path.is_dir()}
    there = {f"{group}={name}" for group in groups for name in choices(group, words)}
    chosen = [word for word in words if word in there]
    config: Any = composed([*(f"{FLAGS[0]}={folder}" for folder in _typed(words)), *chosen])
    return [*groups, *leaves(OmegaConf.to_container(config, resolve=False))]


def leaves(config: Any, prefix: str = "") -> Iterator[str]:
    """The names of all settings in `config`, with dots between the levels."""
    for key, value in config.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{key}.")
        elif not key.startswith("_"):
            yield f"{prefix}{key}"


def _overrides(words: Sequence[str]) -> list[str]:
    return [word for word in words if not word.startswith(f"{FLAGS[0]}=")]


def _folders(words: Sequence[str]) -> list[Path]:
    """Our configurations, the folders that `words` name, and those of installed plug-ins."""
    return [CONFIGS, *_typed(words), *plug_ins.folders()]


def _typed(words: Sequence[str]) -> list[Path]:
    """The folders that `words` name: `--config-dir=DIR` or, as Hydra takes it too, in two words."""
    further = []
    for word, after in pairwise([*words, ""]):
        name, equals, value = word.partition("=")
        if name in FLAGS:
            further.append(Path(value if equals else after).resolve())
    return further
