"""Builds objects from the nodes of a configuration; errors name the setting."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Collection, Mapping
from dataclasses import is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.errors import SteerbenchError
from sweeps.names import unknown

STANDS_FOR = {"Path": str, "tuple": list, "Sequence": list, "Mapping": dict, "float": float | int}
"""By the name of a type in a signature: the type that a configuration holds instead."""


def target_of(node: Mapping[str, Any] | DictConfig) -> Any:
    """The class or function that the `_target_` of `node` names.

    Raises:
        SteerbenchError: it cannot be imported.
    """
    try:
        return pkgutil.resolve_name(node["_target_"])
    except (ImportError, AttributeError, ValueError) as error:
        raise SteerbenchError(
            f"cannot import {node['_target_']}: {error}; PYTHONPATH must name the folder of a "
            "package that is not installed"
        ) from error


def engine_kinds(files: Mapping[str, Path]) -> dict[str, Any]:
    """The class of each engine by name, from its file; torch, the standard, comes first."""
    names = sorted(files, key=lambda name: (name != "torch", name))
    return {name: target_of(OmegaConf.load(files[name])) for name in names}  # type: ignore[arg-type]


def build(config: DictConfig, group: str, *args: Any, **extra: Any) -> Any:
    """Call the `_target_` of `config[group]` with its settings, `args` and `extra`.

    Nodes below it that have a `_target_` are built first. Exceptions of a target pass through.

    Raises:
        SteerbenchError: a setting is missing, unknown to its target, or of the wrong type, or the
            target does not exist.
    """
    try:
        missing = sorted(OmegaConf.missing_keys(config[group]))  # full keys: "scene.path"
        if missing:
            raise SteerbenchError(f"{missing[0]} is not set: give {missing[0]}=...")
        node: Any = OmegaConf.to_container(config[group], resolve=True)
    except OmegaConfBaseException as error:  # a setting that others use was removed (~backend)
        raise SteerbenchError(f"{group}: {str(error).splitlines()[0]}") from error
    target = target_of(node)
    given = [*list(inspect.signature(target).parameters)[: len(args)], *extra]
    check_settings(target, node, f"{group}.", given)
    try:
        prepared = instantiate(node, _partial_=True, _convert_="all")
        return prepared(*args, **extra)
    except (InstantiationException, ValueError) as error:
        cause = (isinstance(error, InstantiationException) and error.__cause__) or error
        if isinstance(cause, ValueError):  # the target's message names the setting
            raise SteerbenchError(f"{group}: {cause}") from error
        raise cause from error


def check_settings(
    target: Any, settings: Mapping[str, Any], prefix: str = "", given: Collection[str] = ()
) -> None:
    """Raise `SteerbenchError` unless `target` accepts these settings, by name and type.

    Errors put `prefix` before the names. Parameters `given` by the caller are not settings.
    Settings that are nodes with a `_target_` are checked against that target.
    """
    # Types of inherited dataclass fields must be looked up in the modules of its bases.
    plain = inspect.isclass(target) and not is_dataclass(target)
    hints = get_type_hints(target.__init__ if plain else target)
    parameters = inspect.signature(target).parameters
    names = [name for name in parameters if name not in given]
    if not settings.get("_partial_"):
        for name in names:  # ~name removes a default of the configurations
            if _required(parameters[name]) and name not in settings:
                raise SteerbenchError(f"{prefix}{name} is not set: give {prefix}{name}=...")
    for name, value in settings.items():
        if name.startswith("_"):  # Hydra's own: _target_, _convert_
            continue
        if name not in names:
            raise unknown("setting", f"{prefix}{name}", [f"{prefix}{other}" for other in names])
        if isinstance(value, dict) and "_target_" in value:
            check_settings(target_of(value), value, f"{prefix}{name}.")
        elif not _fits(value, hints.get(name, Any)):
            wanted = " or ".join(map(str, _choices(hints[name]))) or parameters[name].annotation
            raise SteerbenchError(f"{prefix}{name}: expected {wanted}, got {value!r}")


def _required(parameter: inspect.Parameter) -> bool:
    several = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    return parameter.default is inspect.Parameter.empty and parameter.kind not in several


def _choices(hint: Any) -> tuple[object, ...]:
    """The values that a `Literal` allows; empty for other types."""
    return get_args(hint) if get_origin(hint) is Literal else ()


def _fits(value: object, hint: Any) -> bool:
    """Whether a plain YAML `value` has the type `hint`; True if that cannot be decided."""
    if get_origin(hint) is UnionType:
        return any(_fits(value, option) for option in get_args(hint))
    if choices := _choices(hint):
        return value in choices
    kind = get_origin(hint) or hint
    kind = STANDS_FOR.get(getattr(kind, "__name__", ""), kind)
    if not isinstance(kind, type | UnionType):
        return True
    return isinstance(value, kind) and (kind is bool or not isinstance(value, bool))
