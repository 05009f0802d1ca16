"""Throughput of every kernel and backend. A kernel that is wrong gets a status, not a time."""

from __future__ import annotations

import importlib
import statistics
import time
from typing import Any

import torch

from bench.errors import Unavailable
from methods.kernels.case import Case, Prepared, largest_error
from methods.kernels.dispatch import BACKENDS, resolve

CASE_MODULES = (
    "methods.kernels.encode.cases",
    "methods.kernels.march.cases",
    "methods.kernels.composite.cases",
    "methods.kernels.spherical.cases",
    "methods.kernels.adam.cases",
    "methods.step_cases",
)


def all_cases() -> list[Case]:
    """The cases of all kernels, and those of the training step that is made of them."""
    return [case for name in CASE_MODULES for case in importlib.import_module(name).cases()]


def main_rows(name_filter: str, repeats: int) -> list[dict[str, Any]]:
    """One row for each timed case and backend of the kernels with `name_filter` in their name.

    A row holds kernel, case, backend, dtype, error and tolerance (absolute, against the
    reference), status ("ok" or what is wrong), ms (median of `repeats`), mitems_s (million items a
    second) and ratio (time of the reference over that of this backend, the two timed in turn).
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    rows = []
    for case in all_cases():
        if case.timed and name_filter in case.kernel:
            rows += _case_rows(case, device, repeats)
    return rows


def _case_rows(case: Case, device: str, repeats: int) -> list[dict[str, Any]]:
    prepared = case.prepare(device)
    reference = prepared.call("reference")
    others = [name for name in BACKENDS if name != "reference" and _serves(name, device)]
    errors = {name: largest_error(prepared.call(name), reference) for name in others}
    errors["reference"] = 0.0
    correct = [name for name, error in errors.items() if error <= prepared.tolerance]
    times = _times_ms(prepared, correct, repeats, device)
    rows = []
    for name in ("reference", *others):
        row: dict[str, Any] = {
            "kernel": case.kernel,
            "case": case.name,
            "backend": name,
            "dtype": case.dtype,
            "error": errors[name],
            "tolerance": prepared.tolerance,
            "status": "ok" if name in correct else "wrong",
        }
        if name in correct:
            row["ms"] = times[name]
            row["mitems_s"] = case.items / times[name] / 1e3
            row["ratio"] = times["reference"] / times[name]
        rows.append(row)
    return rows


def _serves(backend: str, device: str) -> bool:
    try:
        return resolve(backend, device) == backend
    except Unavailable:
        return False


def _times_ms(
    prepared: Prepared, backends: list[str], repeats: int, device: str
) -> dict[str, float]:
    """Median milliseconds of each backend; they take turns, so that a drifting clock hits all."""
    times: dict[str, list[float]] = {name: [] for name in backends}
    for _ in range(repeats):
        for name in backends:
            _synchronise(device)
            begun = time.perf_counter()
            prepared.call(name)
            _synchronise(device)
            times[name].append(1e3 * (time.perf_counter() - begun))
    return {name: statistics.median(values) for name, values in times.items()}


def _synchronise(device: str) -> None:
    if device == "cuda":
        torch.cuda.synchronize()
