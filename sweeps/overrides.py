"""The configuration that overrides describe; what is wrong with them, in the words of who typed
them."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from sweeps.names import unknown

CONFIGS = Path(__file__).parent / "configs"


def composed(overrides: Sequence[str], **options: bool) -> DictConfig:
    """The configuration of a run; `options` as of Hydra's `compose`.

    Raises:
        SteerbenchError: a setting or a choice does not exist, or cannot be read.
    """
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            return compose("run", overrides=list(overrides), **options)
    except Exception as error:
        if not of_hydra(error):
            raise
        raise explain(error, overrides) from error


def of_hydra(error: Exception) -> bool:
    """Whether Hydra raised it. Its own exceptions are not all: some of the wrong things that can be
    typed (budget=0.0) it answers with a ValueError or with what its parser stumbled over."""
    *_, (innermost, _) = traceback.walk_tb(error.__traceback__)
    return innermost.f_globals["__name__"].partition(".")[0] in ("hydra", "omegaconf", "antlr4")


def swept(overrides: Sequence[str], loader: ConfigLoader | None = None) -> dict[str, list[str]]:
    """The values of every setting that takes several in turn (seed=0,1,2); later ones count.

    Args:
        loader: of Hydra's, where a choice may be given as a pattern (method=*).

    Raises:
        SteerbenchError: one of them cannot be read.
    """
    try:
        parsed = OverridesParser.create(loader).parse_overrides(list(overrides))
    except Exception as error:
        if not of_hydra(error):
            raise
        raise explain(error, overrides) from error
    values = {
        override.get_key_element(): list(override.sweep_string_iterator())
        if override.is_discrete_sweep()
        else []
        for override in parsed
    }
    return {name: several for name, several in values.items() if several}


def explain(error: Exception, argv: Sequence[str]) -> SteerbenchError:
    """Translate an error of Hydra's; names that do not exist come with the nearest that do."""
    if isinstance(error, OverrideParseException):
        return SteerbenchError(
            f"cannot read '{error.override}': settings are written key=value, "
            f"for example seed=1 or scene=wires ({error.message.splitlines()[0]})"
        )
    if isinstance(error, MissingConfigException) and error.missing_cfg_file and error.options:
        group, _, name = error.missing_cfg_file.rpartition("/")
        return unknown(group, name, error.options)
    key = re.match(r"Could not override '([^']+)'", str(error))
    if key:
        return unknown("setting", key[1], _settings(argv))
    causes = [error, error.__cause__] if error.__cause__ else [error]
    lines = [line.strip() for cause in causes for line in str(cause).splitlines()]
    return SteerbenchError("; ".join(line for line in lines if line))


def _settings(argv: Sequence[str]) -> list[str]:
    """All that can be set, given the choices (scene=blender) in `argv`."""
    groups = [path.name for path in CONFIGS.iterdir() if path.is_dir()]
    there = {str(path.relative_to(CONFIGS))[:-5] for path in CONFIGS.glob("*/*.yaml")}
    choices = [argument for argument in argv if argument.replace("=", "/", 1) in there]
    with initialize_config_dir(str(CONFIGS), version_base="1.3"):
        config = OmegaConf.to_container(compose("run", overrides=choices), resolve=False)
    assert isinstance(config, dict)
    return [*groups, *leaves(config)]


def leaves(config: Mapping, prefix: str = "") -> Iterator[str]:
    """The names of all settings in `config`, with dots between the levels."""
    for key, value in config.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{key}.")
        elif not key.startswith("_"):
            yield f"{prefix}{key}"
