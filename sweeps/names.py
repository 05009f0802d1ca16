"""Errors about unknown names: they give near matches, and what exists."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

from bench.errors import SteerbenchError


def unknown(kind: str, name: str, existing: Iterable[str]) -> SteerbenchError:
    """The error for a `name` not among `existing`; it suggests near ones."""
    names = sorted(existing)
    near = _nearest(name, names)
    guess = f" Did you mean {' or '.join(near)}?" if near else ""
    return SteerbenchError(f"unknown {kind} '{name}'.{guess} There are: {', '.join(names)}.")


def _nearest(name: str, names: Sequence[str]) -> list[str]:
    """Near names on the same level (scene.path for scene.pth); if none, near names anywhere."""
    place = name[: name.rfind(".") + 1]
    beside = {other.removeprefix(place): other for other in names if other.startswith(place)}
    near = get_close_matches(name.removeprefix(place), beside)
    return [beside[last] for last in near] or get_close_matches(name, names)
