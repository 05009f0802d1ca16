"""Objects from the nodes of a configuration, with errors that name the setting."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from sweeps.names import unknown

STANDS_FOR = {"Path": str, "tuple": list, "Sequence": list, "Mapping": dict, "float": float | int}
"""What a configuration holds where the name of a type on the left is asked for."""


def build(config: DictConfig, group: str, *args: Any, **extra: Any) -> Any:
    """Call the `_target_` of `config[group]` with its settings, `args` and `extra`.

    What the target itself raises passes through unchanged.

    Raises:
        SteerbenchError: a setting is missing, unknown to the target, or of another type.
    """
    missing = sorted(OmegaConf.missing_keys(config[group]))  # full keys: "scene.path"
    if missing:
        raise SteerbenchError(f"{missing[0]} is not set: give {missing[0]}=...")
    try:
        target = instantiate(config[group], _partial_=True, _convert_="all")
    except InstantiationException as error:
        raise SteerbenchError(f"{group}: {' '.join(str(error).split())}") from error
    taken = [*list(inspect.signature(target.func).parameters)[: len(args)], *extra]
    check_types(target.func, target.keywords, f"{group}.", taken)
    return target(*args, **extra)


def check_types(
    target: Any, settings: Mapping[str, Any], prefix: str = "", taken: Sequence[str] = ()
) -> None:
    """Raise `SteerbenchError` unless `target` takes these settings, by name and by type.

    `prefix` stands before their names in the error; the parameters in `taken` cannot be set.
    """
    parameters = inspect.signature(target).parameters
    hints = get_type_hints(target.__init__ if inspect.isclass(target) else target)
    free = [name for name in parameters if name not in taken]
    for name, value in settings.items():
        if name not in free:
            raise unknown("setting", f"{prefix}{name}", [f"{prefix}{other}" for other in free])
        if not _fits(value, hints.get(name, Any)):
            wanted = parameters[name].annotation
            raise SteerbenchError(f"{prefix}{name}: expected {wanted}, got {value!r}")


def _fits(value: object, hint: Any) -> bool:
    """Whether a plain YAML `value` can stand where `hint` is asked for; if in doubt, it can."""
    if get_origin(hint) is UnionType:
        return any(_fits(value, option) for option in get_args(hint))
    kind = get_origin(hint) or hint
    kind = STANDS_FOR.get(getattr(kind, "__name__", ""), kind)
    if isinstance(value, bool) and kind is not bool:
        return not isinstance(kind, type | UnionType)
    return not isinstance(kind, type | UnionType) or isinstance(value, kind)
