"""`steerbench list`: what can be chosen, and what of it cannot be used on this machine, and why."""

from __future__ import annotations

import argparse
from contextlib import suppress
from importlib import metadata
from typing import Any

from bench.errors import Unavailable
from reports.tables import Table
from sweeps.overrides import CONFIGS
from sweeps.terminal import console, rich_table
from sweeps.variants import engine_kinds

GROUPS = ("method", "engine", "scene", "trajectory", "protocol", "budget", "experiment")


def main(options: argparse.Namespace) -> int:
    """Print the choices of `steerbench run`, then the backends of the kernels and the engines."""
    from methods.kernels import availability

    backends = tuple((name, why or "usable") for name, why in availability().items())
    for title, columns, lines in (
        ("Choices", ("choice", "what it is"), choices()),
        ("Backends of the kernels", ("backend", "here"), backends),
        ("Engines of the networks", ("engine", "here"), engines()),
    ):
        console().print(rich_table(Table(title, columns, lines, figures=False)))
    return 0


def choices() -> tuple[tuple[str, str], ...]:
    """Every `group=name` there is, with the first comment of its file."""
    return tuple(
        (f"{'+' if group == 'experiment' else ''}{group}={path.stem}", _comment(path.read_text()))
        for group in GROUPS
        for path in sorted((CONFIGS / group).glob("*.yaml"))
    )


def engines() -> tuple[tuple[str, str], ...]:
    """Every engine, and whether it can be used here, or why not."""
    return tuple((name, _state(name, kind)) for name, kind in engine_kinds().items())


def _state(name: str, kind: Any) -> str:
    try:
        kind(kind.precisions[0])
    except Unavailable as reason:
        return str(reason)
    with suppress(metadata.PackageNotFoundError):  # an engine need not be called as its library
        return f"usable (version {metadata.version(name)})"
    return "usable"


def _comment(text: str) -> str:
    """The first comment that is not a directive of Hydra's (`# @package`)."""
    lines = (line.removeprefix("#").strip() for line in text.splitlines() if line.startswith("#"))
    return next((line for line in lines if not line.startswith("@")), "")
