"""Throughput of every kernel and backend. A kernel that is wrong gets a status, not a time."""

from __future__ import annotations

import importlib
import math
import statistics
import time
from typing import Any

import torch

from bench.types import Log, Unavailable
from methods.kernels.case import Case, Prepared, largest_error
from methods.kernels.dispatch import BACKENDS, has, interpreted, resolve

CASE_MODULES = (
    "methods.kernels.encode.cases",
    "methods.kernels.march.cases",
    "methods.kernels.composite.cases",
    "methods.kernels.spherical.cases",
    "methods.kernels.adam.cases",
    "methods.kernels.splat.cases",
    "methods.kernels.warp.cases",
    "methods.kernels.depthwise.cases",
    "methods.kernels.space_to_depth.cases",
    "methods.instant_ngp.cases",
)


def all_cases() -> list[Case]:
    """The cases of all kernels, and those of the training step that is made of them."""
    return [case for name in CASE_MODULES for case in importlib.import_module(name).cases()]


def main_rows(name_filter: str, repeats: int, log: Log) -> list[dict[str, Any]]:
    """One row for each timed case and backend of the kernels with `name_filter` in their name.

    A row holds kernel, case, backend, dtype, error and tolerance (absolute, against the
    reference; error None where it is not finite), status ("ok", or on which cases of the kernel
    the backend is wrong, timed or not), ms (median of `repeats`), mitems_s (million items a
    second) and ratio (time of the reference over that of this backend, the two timed in turn).
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    others = [name for name in BACKENDS if name != "reference" and _usable(name, device)]
    cases = [case for case in all_cases() if name_filter in case.kernel]
    timed = [case for case in cases if case.timed]
    wrong: dict[tuple[str, str], list[str]] = {}
    errors: list[dict[str, float]] = []
    rows = []
    with log.progress("kernels", len(cases) + len(timed)) as progress:
        for case in cases:  # all of them before any is timed: what is wrong has no speed
            prepared = case.prepare(device)
            errors.append(_errors(prepared, [name for name in others if _serves(name, case)]))
            for backend, error in errors[-1].items():
                if not error <= prepared.tolerance:
                    wrong.setdefault((case.kernel, backend), []).append(case.name)
            progress.advance(note=f"{case.kernel}, {case.name}")
        for case, of_case in zip(cases, errors, strict=True):
            if case.timed:
                statuses = {name: _status(wrong.get((case.kernel, name))) for name in of_case}
                rows += _timed_rows(case, of_case, statuses, repeats, device)
                progress.advance(note=f"timed: {case.kernel}, {case.name}")
    return rows


def _errors(prepared: Prepared, others: list[str]) -> dict[str, float]:
    """Largest error of each backend; the reference is right by definition."""
    reference = prepared.call("reference")
    return {"reference": 0.0} | {
        name: largest_error(prepared.call(name), reference) for name in others
    }


def _status(wrong_cases: list[str] | None) -> str:
    return f"wrong: {', '.join(wrong_cases)}" if wrong_cases else "ok"


def _timed_rows(
    case: Case,
    errors: dict[str, float],
    statuses: dict[str, str],
    repeats: int,
    device: str,
) -> list[dict[str, Any]]:
    prepared = case.prepare(device)
    correct = [name for name, status in statuses.items() if status == "ok"]
    times = _times_ms(prepared, correct, repeats, device)
    rows = []
    for name, error in errors.items():
        row: dict[str, Any] = {
            "kernel": case.kernel,
            "case": case.name,
            "backend": name,
            "dtype": case.dtype,
            "error": error if math.isfinite(error) else None,
            "tolerance": prepared.tolerance,
            "status": statuses[name],
        }
        if name in correct:
            row["ms"] = times[name]
            row["mitems_s"] = case.items / times[name] / 1e3
            row["ratio"] = times["reference"] / times[name]
        rows.append(row)
    return rows


def _usable(backend: str, device: str) -> bool:
    """Whether it is for this device; what an interpreter takes says nothing of a kernel."""
    try:
        resolve(backend, device)
    except Unavailable:
        return False
    return not (backend == "gpu" and interpreted())


def _serves(backend: str, case: Case) -> bool:
    """Whether `backend` computes the kernel of `case` itself; what is made of several kernels is
    not that of any folder."""
    folder = case.kernel.partition(" ")[0]
    return has(folder, backend) or not has(folder, "reference")


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
