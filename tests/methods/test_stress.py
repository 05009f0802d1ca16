"""What must hold where numbers are extreme: all but the slow cases of `steerbench stress`."""

from __future__ import annotations

import importlib

import pytest

from bench.stress import Cell, StressCase
from methods.stress import CASE_MODULES, all_cases

CASES = all_cases()
CELLS = [
    pytest.param(case, cell, id=f"{case.subject}: {case.name}: {' '.join(cell)}")
    for case in CASES
    if not case.slow
    for cell in case.tolerances
]


@pytest.mark.parametrize(("case", "cell"), CELLS)
def test_it_holds(case: StressCase, cell: Cell, device: str) -> None:
    row = case.check(cell, device)
    if row["status"].startswith("unavailable"):
        pytest.skip(row["status"])
    assert row["status"] == "ok", row


def test_no_two_cases_have_the_same_name() -> None:
    names = [(case.subject, case.name) for case in CASES]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("module", CASE_MODULES)
def test_every_module_has_cases(module: str) -> None:
    assert importlib.import_module(module).cases()
