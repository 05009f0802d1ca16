"""Errors about names: what was typed, what is nearest to it, what exists."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from difflib import get_close_matches

from bench.errors import SteerbenchError


def unknown(kind: str, name: str, existing: Iterable[str]) -> SteerbenchError:
    """The error for a `name` that is none of the `existing` ones, with the nearest of them."""
    names = sorted(existing)
    near = _nearest(name, names)
    guess = f" Did you mean {' or '.join(near)}?" if near else ""
    return SteerbenchError(f"unknown {kind} '{name}'.{guess} There are: {', '.join(names)}.")


def _nearest(name: str, names: Sequence[str]) -> list[str]:
    """Names beside it (scene.path for scene.pth) if any is near, else near ones from anywhere."""
    place = name[: name.rfind(".") + 1]
    beside = {other.removeprefix(place): other for other in names if other.startswith(place)}
    near = get_close_matches(name.removeprefix(place), beside)
    return [beside[last] for last in near] or get_close_matches(name, names)
