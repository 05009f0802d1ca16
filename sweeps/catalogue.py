"""`steerbench list`: what can be chosen, and what of it cannot be used on this machine, and why."""

from __future__ import annotations

import argparse
import importlib.util
from importlib import metadata

import torch

from reports.tables import Table
from sweeps.overrides import CONFIGS
from sweeps.terminal import console, rich_table

GROUPS = ("method", "engine", "scene", "trajectory", "protocol", "budget", "experiment")

EXTRAS = {"openvino": "openvino", "onnxruntime": "onnx"}
"""Engines that run the network of a 2D renderer beside torch, and the extra that installs each."""


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
    """Every engine, and whether it can be used here or how to get it."""
    rows = [("torch", f"usable (version {torch.__version__})")]
    for name, extra in EXTRAS.items():
        if importlib.util.find_spec(name) is None:
            rows.append((name, f'not installed: pip install -c constraints.txt -e ".[{extra}]"'))
        else:
            rows.append((name, f"usable (version {metadata.version(name)})"))
    rows.append(("tensorrt", "not yet: on a GPU, engine=torch precision=fp16"))
    return tuple(rows)


def _comment(text: str) -> str:
    """The first comment that is not a directive of Hydra's (`# @package`)."""
    lines = (line.removeprefix("#").strip() for line in text.splitlines() if line.startswith("#"))
    return next((line for line in lines if not line.startswith("@")), "")
