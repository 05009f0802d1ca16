"""Errors for users. Not in `bench.types`, so that the command line need not load torch."""

import importlib
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any

NAMED = 5  # an error names at most this many things and gives the number of the rest


class SteerbenchError(Exception):
    """An error a user can act on: its message says what was expected, what came and what to do.

    The command line prints the message alone, without a traceback, and exits with status 2.
    """


class Unavailable(SteerbenchError):
    """Something asked for by name cannot be used here; the message says why and how to get it."""


def unexpected(where: str | Path, expected: str, got: object) -> SteerbenchError:
    """The error that says what was expected at `where` (an option; a file and its field)."""
    return SteerbenchError(f"{where}: expected {expected}, got {got}")


def unknown(kind: str, name: str, existing: Iterable[str]) -> SteerbenchError:
    """The error for a `name` not among `existing`, with those that are near, or all.

    Near are first names on the same level (scene.path for scene.pth), then names anywhere.
    """
    names, place = sorted(existing), name[: name.rfind(".") + 1]
    beside = {other.removeprefix(place): other for other in names if other.startswith(place)}
    near = [beside[last] for last in get_close_matches(name.removeprefix(place), beside)]
    near = near or get_close_matches(name, names)
    more = f"Did you mean {' or '.join(near)}?" if near else f"There are: {', '.join(names)}."
    return SteerbenchError(f"unknown {kind} '{name}'. {more}")


def not_there(path: Path, expected: str = "a file") -> SteerbenchError:
    """The error for a `path` that is not what is `expected`; if nothing is there, it names what is
    nearest to the first part of the path that is missing."""
    if path.exists():
        return unexpected(path, expected, "a folder" if path.is_dir() else "a file")
    if path.is_symlink():
        return unexpected(path, expected, f"a link to {path.readlink()}, which is not there")
    gone = path
    while not gone.parent.exists():
        gone = gone.parent
    there = sorted(each.name for each in gone.parent.iterdir()) if gone.parent.is_dir() else ()
    near = f"no '{gone.name}' in {gone.parent}; nearest: {nearest(gone.name, there)}"
    return unexpected(path, expected, near)


def nearest(name: str, there: Iterable[str]) -> str:
    """The one of the names `there` that is most like `name`, in any case; if none is, all."""
    names = {each.lower(): each for each in there}
    near = get_close_matches(name.lower(), names, 1)
    return names[near[0]] if near else some([*names.values()]) or "nothing"


def some(names: Sequence[str]) -> str:
    """The first of `names`, and how many more there are."""
    further = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + further


def reason(error: BaseException) -> str:
    """The message of `error` in one line."""
    return " ".join(str(error).split()) or type(error).__name__


def install_command(extra: str) -> str:
    """The command that installs an `extra` of this project from its folder."""
    return f'pip install -c constraints.txt -e ".[{extra}]"'


def optional(library: str, extra: str, needed_by: str, otherwise: str = "") -> Any:
    """Import a `library` of an `extra`; raises Unavailable without it, which says what it is
    `needed_by`, how to install it, and what can be done `otherwise`."""
    try:
        with warnings.catch_warnings():  # those of others about others
            warnings.simplefilter("ignore")
            return importlib.import_module(library)
    except ImportError as error:
        how = f"{install_command(extra)}{otherwise}"
        raise Unavailable(f"{needed_by} needs {error.name or error}: {how}") from error


@contextmanager
def explained(folder: Path) -> Iterator[None]:
    """Turn an OSError about a `folder` that cannot be written into a SteerbenchError."""
    try:
        yield
    except OSError as error:
        raise SteerbenchError(
            f"cannot write to {error.filename or folder}: {error.strerror or error}. Make room, "
            "correct the permissions, or choose another folder; outputs=DIR moves all results"
        ) from error
