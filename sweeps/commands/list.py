"""`steerbench list`: what can be chosen, and why some of it cannot be used here."""

import argparse
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError
from bench.kinds import Words
from reports.tables import Table
from sweeps.overrides import choices, described, engine_kinds, plug_ins
from sweeps.terminal import console, show

GROUPS = ("method", "engine", "scene", "trajectory", "protocol", "budget", "+experiment")


def main(options: argparse.Namespace) -> int:
    """Print the choices of `steerbench run`; with `--here`, also the usable backends and engines.

    `--here` is optional because it takes seconds: it imports torch and the engines.
    """
    words = options.config_dir
    files = [
        (f"{group}={name}", about)
        for group in GROUPS
        for name, about in described(group.lstrip("+"), words).items()
    ]
    _show("Choices", ("choice", "what it is"), files)
    installed = [(name, _brings(folder, words)) for name, folder in plug_ins().items()]
    _show("Installed plug-ins", ("plug-in", "what it brings"), installed)
    if not options.here:
        console().print("Backends and engines that this machine can use: steerbench list --here")
        return 0

    from methods.kernels import availability

    backends = [(name, why or "usable") for name, why in availability().items()]
    _show("Backends of the kernels", ("backend", "here"), backends)
    engines = [(name, _state(name, kind)) for name, kind in engine_kinds(words).items()]
    _show("Engines of the networks", ("engine", "here"), engines)
    return 0


def _show(title: str, columns: tuple[str, str], lines: Sequence[tuple[str, str]]) -> None:
    if lines:
        show(Table(title, columns, lines))


def _brings(folder: Path | str, words: Words) -> str:
    """The choices of a plug-in's folder, or why it has none."""
    if isinstance(folder, str):
        return f"cannot be used: {folder}"
    brought = []
    for path in sorted(folder.glob("*/*.yaml")):
        group, hidden = path.parent.name, choices(path.parent.name, words)[path.stem] != path
        brought.append(f"{group}={path.stem}" + (" (hidden: the name is taken)" if hidden else ""))
    return ", ".join(brought) or f"nothing: there are no GROUP/NAME.yaml in {folder}"


def _state(name: str, kind: Any) -> str:
    try:
        kind(kind.precisions[0])
    except SteerbenchError as reason:
        return str(reason)
    with suppress(metadata.PackageNotFoundError):  # an engine's name may differ from its library's
        return f"usable (version {metadata.version(name)})"
    return "usable"
