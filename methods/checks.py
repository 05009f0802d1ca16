"""All checks of the methods: the `cases.py` and `experiments.py` of their folders."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent


def found(name: str) -> list[Any]:
    """What the function `name` of every module `name` below this folder returns, in one list."""
    return [check for module in _modules(name) for check in getattr(module, name)()]


def _modules(name: str) -> Iterator[Any]:
    for path in sorted(HERE.rglob(f"{name}.py")):
        folder = ".".join(path.parent.relative_to(HERE.parent).parts)
        yield importlib.import_module(f"{folder}.{name}")
