"""All stress cases of the methods; each stands beside what it tests."""

from __future__ import annotations

import importlib

from bench.stress import StressCase

CASE_MODULES = (
    "bench.camera_stress",
    "methods.kernels.composite.stress",
    "methods.kernels.encode.stress",
    "methods.kernels.march.stress",
    "methods.kernels.splat.stress",
    "methods.kernels.warp.stress",
    "methods.instant_ngp.stress",
    "methods.engines.stress",
)


def all_cases() -> list[StressCase]:
    """The cases of all modules."""
    return [case for name in CASE_MODULES for case in importlib.import_module(name).cases()]
