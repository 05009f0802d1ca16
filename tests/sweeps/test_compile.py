"""`steerbench compile`: computes the cases of the kernels, whose code numba then keeps."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from bench.case import Case, Cell
from bench.errors import Unavailable
from sweeps.commands.compile import compiled

CPU = ("cpu", "fp32")
TOLERANCES = {CPU: 0.1, ("reference", "fp32"): 0.1}


def module(monkeypatch: pytest.MonkeyPatch, error: float, **options: bool) -> list[Cell]:
    """Make a module `stand_in` with one case of this error; return the cells it has computed."""
    computed: list[Cell] = []

    def measure(backend: str, device: str, precision: str) -> float:
        computed.append((backend, precision))
        return error

    put(monkeypatch, Case("march", "empty", "", "", TOLERANCES, measure, **options))
    return computed


def put(monkeypatch: pytest.MonkeyPatch, case: Case) -> None:
    monkeypatch.setitem(sys.modules, "stand_in", SimpleNamespace(cases=lambda: [case]))


def test_only_what_is_compiled_is_computed(monkeypatch):
    computed = module(monkeypatch, error=0.0)
    assert compiled("stand_in") == []
    assert computed == [CPU]


def test_a_case_that_takes_long_is_left_out(monkeypatch):
    computed = module(monkeypatch, error=0.0, slow=True)
    assert compiled("stand_in") == computed == []


def test_a_wrong_kernel_is_named(monkeypatch):
    module(monkeypatch, error=0.5)
    assert compiled("stand_in") == ["march: empty"]


def test_a_kernel_that_this_machine_cannot_have_is_not_wrong(monkeypatch):
    def refuse(*cell: str) -> float:
        raise Unavailable("no such products")

    put(monkeypatch, Case("march", "empty", "", "", TOLERANCES, refuse))
    assert compiled("stand_in") == []


@pytest.mark.slow
def test_the_command_computes_the_cases_of_all_modules_in_processes(steerbench, monkeypatch):
    monkeypatch.setattr("methods.checks.modules", lambda name: ["methods.kernels.spherical.cases"])
    assert steerbench("compile").status == 0
    monkeypatch.setattr("methods.checks.modules", lambda name: ["methods.kernels.spherical"])
    with pytest.raises(AttributeError, match="has no attribute 'cases'"):
        steerbench("compile")
