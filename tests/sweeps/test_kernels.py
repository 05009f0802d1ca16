"""`steerbench kernels`: a table, then JSON; a kernel that is wrong fails the command."""

from __future__ import annotations

import fcntl
import json

import pytest

from bench.case import Case
from bench.types import Log
from sweeps.device_lock import lock_file

RIGHT = {
    "kernel": "encode", "case": "view", "backend": "cpu", "dtype": "float32", "error": 1e-7,
    "tolerance": 1e-6, "status": "ok", "ms": 12.5, "mitems_s": 10.4, "ratio": 31.0,
}  # fmt: skip
WRONG = {
    "kernel": "march", "case": "empty", "backend": "cpu", "dtype": "float32", "error": 0.5,
    "tolerance": 1e-6, "status": "wrong",
}  # fmt: skip


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[list[str], int]]:
    """The subjects that were timed, and how often; the rows are `RIGHT` and `WRONG`, by subject."""
    calls = []

    def timed_rows(cases, device, backends, repeats: int, log: Log) -> list[dict]:
        calls.append(([case.subject for case in cases], repeats))
        assert {"reference", "cpu"} & set(backends)
        with lock_file("auto").open() as file, pytest.raises(BlockingIOError):  # it is its turn
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return [row for row in (RIGHT, WRONG) if row["kernel"] in calls[-1][0]]

    def case(subject: str) -> Case:
        return Case(subject, "view", "", "", {}, lambda *cell: 0.0)

    monkeypatch.setattr("methods.checks.found", lambda name: [case("encode"), case("march")])
    monkeypatch.setattr("sweeps.kernels.timed_rows", timed_rows)
    return calls


def test_the_last_line_is_json_of_what_the_table_shows(steerbench, asked):
    outcome = steerbench("kernels", "--filter", "enc", "--repeats", "3")
    assert asked == [(["encode"], 3)]
    assert outcome.status == 0
    for text in ("encode", "1.0e-07", "1.0e-06", "12.50", "10.40", "31.0x"):
        assert text in outcome.out
    assert json.loads(outcome.out.splitlines()[-1]) == [RIGHT]


def test_a_wrong_kernel_shows_its_status_instead_of_a_time_and_fails(steerbench, asked):
    outcome = steerbench("kernels")
    assert outcome.status == 1
    assert "wrong" in outcome.out
    assert json.loads(outcome.out.splitlines()[-1]) == [RIGHT, WRONG]


def test_a_filter_that_fits_nothing_is_an_error(steerbench, asked):
    outcome = steerbench("kernels", "--filter", "splat")
    assert outcome.status == 2
    assert "no kernel has 'splat' in its name" in outcome.err
