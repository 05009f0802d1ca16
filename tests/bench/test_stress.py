"""The runner of stress cases: what counts as a fail, and that a crash is one."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from bench.stress import StressCase, failed, run_cases
from bench.types import Log, Unavailable

CELLS = {("cpu", "fp32"): 1e-6, ("reference", "fp64"): 1e-15}


def case(worst: Callable[[str, str, str], float]) -> StressCase:
    return StressCase("sum", "long", "nothing is lost", "u", CELLS, worst)


def raising(error: Exception) -> Callable[[str, str, str], float]:
    def worst(backend: str, device: str, precision: str) -> float:
        raise error

    return worst


@pytest.mark.parametrize(
    ("seen", "status", "error"),
    [
        (0.0, "ok", 0.0),
        (1e-6, "ok", 1e-6),
        (1.1e-6, "failed", 1.1e-6),
        (math.nan, "failed", None),
        (math.inf, "failed", None),
    ],
)
def test_an_error_is_held_against_the_tolerance_of_its_cell(seen, status, error):
    row = case(lambda *cell: seen).check(("cpu", "fp32"), "cpu")
    assert (row["status"], row["error"]) == (status, error)
    assert failed(row) == (status == "failed")


def test_a_crash_is_a_failed_row_with_its_reason():
    row = case(raising(ZeroDivisionError("by zero"))).check(("cpu", "fp32"), "cpu")
    assert row["status"] == "failed: ZeroDivisionError: by zero"
    assert row["error"] is None
    assert failed(row)


def test_what_cannot_be_had_here_is_said_and_is_no_fail():
    row = case(raising(Unavailable("no such library"))).check(("cpu", "fp32"), "cpu")
    assert row["status"] == "unavailable: no such library"
    assert not failed(row)


def test_every_cell_of_every_case_gets_a_row(quiet_log: Log):
    asked = []

    def worst(backend: str, device: str, precision: str) -> float:
        asked.append((backend, device, precision))
        return 0.0

    rows = list(run_cases([case(worst), case(worst)], ["cuda"], quiet_log))
    assert asked == 2 * [("cpu", "cuda", "fp32"), ("reference", "cuda", "fp64")]
    assert [(row["backend"], row["precision"]) for row in rows] == 2 * list(CELLS)
    assert [row["tolerance"] for row in rows] == 2 * list(CELLS.values())
