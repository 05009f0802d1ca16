"""`steerbench compile`: computes the cases of the kernels, whose code numba then keeps."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest

from bench.case import Case, Cell
from sweeps.compile import compiled

CPU, REFERENCE = ("cpu", "fp32"), ("reference", "fp32")


def module(monkeypatch: pytest.MonkeyPatch, error: float, **options: bool) -> list[Cell]:
    """Make a module `stand_in` with one case of this error; return the cells it has computed."""
    computed: list[Cell] = []

    def measure(backend: str, device: str, precision: str) -> float:
        computed.append((backend, precision))
        return error

    case = Case("march", "empty", "", "", {CPU: 0.1, REFERENCE: 0.1}, measure, **options)
    monkeypatch.setitem(sys.modules, "stand_in", SimpleNamespace(cases=lambda: [case]))
    return computed


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


@pytest.mark.slow
def test_the_command_computes_the_cases_of_all_modules_in_processes(steerbench, monkeypatch):
    monkeypatch.setattr("methods.checks.modules", lambda name: ["methods.kernels.relu.cases"])
    assert steerbench("compile").status == 0
    monkeypatch.setattr("methods.checks.modules", lambda name: ["methods.kernels.relu"])
    with pytest.raises(AttributeError, match="has no attribute 'cases'"):
        steerbench("compile")
