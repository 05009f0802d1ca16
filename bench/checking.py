"""Runs cases: checks every cell, and times the backends that pass."""

from __future__ import annotations

import statistics
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any

from bench.case import Case, Timed
from bench.probes import times_ms
from bench.types import Log


def run_cases(cases: Sequence[Case], devices: Sequence[str], log: Log) -> Iterator[dict[str, Any]]:
    """Check all cells of `cases` on all `devices`, and yield their rows; see `Case.check`."""
    cells = sum(len(case.tolerances) for case in cases)
    with log.progress("stress", cells * len(devices)) as progress:
        for case, device in product(cases, devices):
            for cell in case.tolerances:
                progress.advance(0, note=f"{case.subject}, {case.name}: {' '.join(cell)}")
                yield case.check(cell, device)
                progress.advance(note="")


def failed(row: Mapping[str, Any]) -> bool:
    """Whether the check of this row failed."""
    return row["status"].startswith("failed")


def timed_rows(
    cases: Sequence[Case], device: str, backends: Collection[str], repeats: int, log: Log
) -> list[dict[str, Any]]:
    """Check the cases and time the correct ones; one row per timed case and supported backend.

    A row holds kernel, case, backend, dtype, error and tolerance (absolute; error is None if not
    finite), status ("ok", or the cases of the kernel that the backend fails, timed or not), ms
    (median of `repeats`), mitems_s (million items a second) and ratio (time of the reference over
    time of this backend). A backend that fails any case of a kernel is not timed.
    """
    subjects = {case.subject for case in cases if case.timed}
    checked = [case for case in cases if case.subject in subjects and not case.slow]
    results: list[tuple[Case, Timed, list[dict[str, Any]]]] = []
    wrong: dict[tuple[str, str], list[str]] = {}
    with log.progress("kernels", len(checked) + sum(bool(c.timed) for c in checked)) as progress:
        for case in checked:
            checks = [case.check(cell, device) for cell in case.tolerances if cell[0] in backends]
            for check in filter(failed, checks):
                wrong.setdefault((case.subject, check["backend"]), []).append(case.name)
            if case.timed:
                results.append((case, case.timed, checks))
            progress.advance(note=f"{case.subject}, {case.name}")
        rows = []
        for case, timed, checks in results:
            for check in checks:
                if names := wrong.get((case.subject, check["backend"])):
                    check["status"] = f"wrong: {', '.join(names)}"
            correct = [check["backend"] for check in checks if check["status"] == "ok"]
            compute = timed.prepare(device)
            of_each = times_ms([partial(compute, name) for name in correct], repeats, device)
            times = dict(zip(correct, map(statistics.median, of_each), strict=True))
            rows += [_row(case.name, timed, check, times) for check in checks]
            progress.advance(note=f"timed: {case.subject}, {case.name}")
    return rows


def _row(
    name: str, timed: Timed, check: Mapping[str, Any], times: Mapping[str, float]
) -> dict[str, Any]:
    backend = check["backend"]
    row = {
        "kernel": check["subject"],
        "case": name,
        "backend": backend,
        "dtype": check["precision"],
        **{key: check[key] for key in ("error", "tolerance", "status")},
    }
    if backend in times:
        row["ms"] = times[backend]
        row["mitems_s"] = timed.items / times[backend] / 1e3
        if "reference" in times:
            row["ratio"] = times["reference"] / times[backend]
    return row
