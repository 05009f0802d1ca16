"""Errors for users. Not in `bench.types`, so that the command line need not load torch."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path


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


def install_command(extra: str) -> str:
    """The command that installs an `extra` of this project from its folder."""
    return f'pip install -c constraints.txt -e ".[{extra}]"'


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
