"""Files of JSON: what is wrong with one is said in one line, with the file and the place in it."""

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from bench.errors import nearest, not_there, unexpected

T = TypeVar("T")

STANDS_FOR = {"Path": str, "tuple": list, "Sequence": list, "Mapping": dict, "float": float | int}
"""By the name of a type in a signature: the type that a file holds instead."""


class Record(dict[str, Any]):
    """An object in the file `path`; a name that it lacks is a SteerbenchError."""

    def __init__(self, held: Any = (), path: Path = Path()) -> None:
        super().__init__(held)
        self.path = path

    def __missing__(self, name: str) -> Any:
        raise unexpected(self.path, f"a field {name}", nearest(name, self))


def read_text(path: Path) -> str:
    """The text of a file; SteerbenchError if it cannot be read."""
    if not path.is_file():
        raise not_there(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise unexpected(path, "a readable text file", error) from error


def read_json(path: Path, kind: Callable[[dict], dict] | None = None, listed: str = "") -> dict:
    """The object in a file of JSON, each inside it made a `kind`; a list is that of its field
    `listed`, where that is given. SteerbenchError if the file is damaged, or holds others."""
    text = read_text(path)
    if not text.strip():
        raise unexpected(path, "JSON", "an empty file")
    try:
        value = json.loads(text, object_hook=kind)
    except json.JSONDecodeError as error:
        at = f"{path}: line {error.lineno}, column {error.colno}"
        raise unexpected(at, "JSON", error.msg) from error
    except (RecursionError, ValueError) as error:
        raise unexpected(path, "JSON", error) from error
    if listed and isinstance(value, list):
        return {listed: value}
    if not isinstance(value, dict):
        raise unexpected(path, "a JSON object", type(value).__name__)
    return value


def read_record(path: Path) -> Any:
    """The `Record` in a file of ours; raises as `read_json` does."""
    return read_json(path, partial(Record, path=path))


def without(values: Mapping[str, Any], names: Collection[str]) -> dict[str, Any]:
    """The `values` by name, but for those of `names`."""
    return {name: value for name, value in values.items() if name not in names}


def made(kind: type[T], held: Any, where: str) -> T:
    """An object of the dataclass `kind` from a record; SteerbenchError if that lacks a field, has
    another, or one of another type, at `where`."""
    if not isinstance(held, Record):
        raise unexpected(where, "an object", type(held).__name__)
    hints = get_type_hints(kind)
    for name in held:
        if name not in hints:
            raise unexpected(where, f"fields of {', '.join(hints)}", name)
    for each in fields(kind):  # type: ignore[arg-type]
        optional = each.default is not MISSING or each.default_factory is not MISSING
        if (each.name in held or not optional) and not fits(held[each.name], hints[each.name]):
            got = repr(held[each.name])[:80]
            raise unexpected(f"{where}.{each.name}", str(each.type), got)
    return kind(**held)


def fits(value: object, hint: Any) -> bool:
    """Whether a plain `value` has the type `hint`; True if that cannot be decided."""
    if hint is Any or (isinstance(value, dict) and (is_dataclass(hint) or "_target_" in value)):
        return True
    if get_origin(hint) is UnionType:
        return any(fits(value, option) for option in get_args(hint))
    if get_origin(hint) is Literal:
        return value in get_args(hint)
    origin, inner = get_origin(hint), get_args(hint)
    kind = STANDS_FOR.get(getattr(origin or hint, "__name__", ""), origin or hint)
    if not isinstance(kind, type | UnionType):
        return True
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        return False
    parts: Iterable[object] = value if isinstance(value, list) and origin is not tuple else ()
    parts = value.values() if isinstance(value, dict) else parts
    return all(fits(part, inner[-1]) for part in parts) if inner else True


def coerced(value: Any, hint: Any) -> Any:
    """A `value` that fits `hint` as that type has it: a whole number as a float where only floats
    are meant, also inside lists and objects."""
    if isinstance(value, list):
        inner = [*get_args(hint), Any][0]
        return [coerced(each, inner) for each in value]
    meant = get_args(hint) if get_origin(hint) is UnionType else (hint,)
    whole = type(value) is int and int not in meant
    return float(value) if whole and float in meant else value
