"""Knobs of kernels and networks that trade time for error, where the exact answer is known."""

from __future__ import annotations

import importlib

from bench.accuracy import Experiment

EXPERIMENT_MODULES = (
    "methods.kernels.composite.experiments",
    "methods.kernels.splat.experiments",
    "methods.instant_ngp.experiments",
)


def all_experiments() -> list[Experiment]:
    """Those of all modules, on the CPU."""
    modules = map(importlib.import_module, EXPERIMENT_MODULES)
    return [experiment for module in modules for experiment in module.experiments()]
