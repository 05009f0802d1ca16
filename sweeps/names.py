"""Errors about names: what was typed, what is nearest to it, what exists."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches

from bench.errors import SteerbenchError


def unknown(kind: str, name: str, existing: Iterable[str]) -> SteerbenchError:
    """The error for a `name` that is none of the `existing` ones, with the nearest of them."""
    names = sorted(existing)
    near = get_close_matches(name, names, n=3, cutoff=0.6)
    guess = f" Did you mean {' or '.join(near)}?" if near else ""
    return SteerbenchError(f"unknown {kind} '{name}'.{guess} There are: {', '.join(names)}.")
