"""All kernels, and all checks: the `cases.py` and `experiments.py` of the folders."""

import importlib
from typing import Any

from bench.provenance import ROOT


def kernels(having: str = "reference") -> list[str]:
    """The packages of all kernels that have a module `having`: "reference", "cpu" or "gpu"."""
    paths = sorted((ROOT / "methods").rglob(f"kernels/*/{having}.py"))
    return [".".join(path.parent.relative_to(ROOT).parts) for path in paths]


def modules(name: str) -> list[str]:
    """The modules of bench and methods that are called `name`: "cases" or "experiments"."""
    paths = sorted(p for top in ("bench", "methods") for p in (ROOT / top).rglob(f"{name}.py"))
    return [".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths]


def found(name: str) -> list[Any]:
    """The results of the function `name` of all modules of this name, in one list."""
    makers = (getattr(importlib.import_module(module), name) for module in modules(name))
    return [check for make in makers for check in make()]
