"""Compiles the kernels of a method for this CPU, so that no training is timed while they are."""

import time
from importlib import import_module

from bench.case import failed
from bench.provenance import sources
from bench.types import Log


def compile_kernels(method: type, backend: str, log: Log) -> float:
    """Compile the kernels that `method` imports, directly or not, and that this machine has no
    machine code of; the seconds that took. Only the backend `cpu` has any."""
    if backend != "cpu":
        return 0.0
    begun = time.monotonic()
    missing = [package for package in _packages(method) if not _compiled(package)]
    if not missing:
        return 0.0
    with log.progress(f"compiling kernels of {method.__name__}, once", len(missing)) as bar:
        for package in missing:
            wrong_of(f"{package}.cases")
            bar.advance()
    return time.monotonic() - begun


def wrong_of(module: str) -> list[str]:
    """Compute each quick case of `module` with compiled kernels; the names of wrong ones.

    This compiles them: cases have all types of inputs.
    """
    quick = [case for case in import_module(module).cases() if case.quick]
    cells = [(case, cell) for case in quick for cell in case.tolerances if cell[0] == "cpu"]
    rows = [case.check(cell, "cpu") for case, cell in cells]
    return [f"{row['subject']}: {row['case']}" for row in rows if failed(row)]


def _packages(method: type) -> list[str]:
    """The kernels with a version for CPUs."""
    ending = "/cpu.py"
    files = [name for name in sources(method) if name.endswith(ending)]
    folders = [name.removesuffix(ending).replace("/", ".") for name in files]
    return sorted(folder for folder in folders if folder != __package__)


def _compiled(package: str) -> bool:
    kept = import_module("methods.kernels.cpu").is_kept
    return any(map(kept, vars(import_module(f"{package}.cpu")).values()))
