"""`steerbench stress`: a table, then JSON; a case that fails fails the command."""

from __future__ import annotations

import json

import pytest

from bench.case import Case
from bench.types import Unavailable


@pytest.fixture(autouse=True)
def two_cases(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that holds, about sums, and one that does not, about products."""

    def case(subject: str, error: float) -> Case:
        cells = {("reference", "fp32"): 1e-6}
        return Case(subject, "long", "all is there", "u", cells, lambda *cell: error)

    cases = [case("sum", 5e-7), case("product", 2)]
    monkeypatch.setattr("methods.checks.found", lambda name: cases)


def test_the_last_line_is_json_of_what_the_table_shows(steerbench):
    outcome = steerbench("stress", "--filter", "sum")
    assert outcome.status == 0
    for text in ("sum", "long", "all is there", "reference", "fp32", "5.0e-07", "1.0e-06", "ok"):
        assert text in outcome.out
    (row,) = json.loads(outcome.out.splitlines()[-1])
    assert (row["subject"], row["error"], row["status"]) == ("sum", 5e-7, "ok")


def test_a_case_that_fails_fails_the_command(steerbench):
    outcome = steerbench("stress")
    assert outcome.status == 1
    assert "2 cases, 2 cells, 1 failed" in outcome.out
    assert [r["status"] for r in json.loads(outcome.out.splitlines()[-1])] == ["ok", "failed"]


def test_a_filter_that_fits_nothing_is_an_error(steerbench):
    outcome = steerbench("stress", "--filter", "quotient")
    assert outcome.status == 2
    assert "no subject or case has 'quotient' in it" in outcome.err


def test_on_a_page_the_cell_nearest_to_its_tolerance_stands_for_a_case(steerbench, monkeypatch):
    seen = {"cpu": 5e-7, "reference": 4e-7, "gpu": Unavailable("no GPU")}
    cells = {("cpu", "fp32"): 1e-6, ("reference", "fp32"): 5e-7, ("gpu", "fp32"): 1e-6}

    def worst(backend: str, device: str, precision: str) -> float:
        if isinstance(seen[backend], Unavailable):
            raise seen[backend]
        return seen[backend]

    case = Case("sum", "long", "all is there", "of rounding", cells, worst)
    monkeypatch.setattr("methods.checks.found", lambda name: [case])
    lines = steerbench("stress", "--format", "markdown").out.splitlines()
    figures = "3 | reference fp32 | 4.0e-07 | 5.0e-07 | ok | of rounding"
    assert lines[2] == f"| sum | long | all is there | {figures} |"
