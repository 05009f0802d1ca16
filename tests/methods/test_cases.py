"""All cases but those that take more than a moment."""

import importlib
import inspect
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from bench.case import Difference, nearest
from methods.checks import found, kernels
from methods.kernels import availability, dispatch
from tests.interpreter import unforgiving

CASES = found("cases")
QUICK = [case for case in CASES if case.quick]
DEAR = ("march", "composite backward", "encode backward")
"""Subjects whose kernels of the GPU have loops or many operations: interpreted, they take long."""


def cells() -> Iterator[Any]:
    """Of a kernel that takes long in the interpreter, `make test` takes the first case."""
    begun = set()
    for case in QUICK:
        for cell in case.tolerances:
            interpreted = cell[0] == "gpu" and not torch.cuda.is_available()
            slow = interpreted and case.subject in DEAR and case.subject in begun
            name = f"{case.subject}: {case.name}: {' '.join(cell)}"
            yield pytest.param(case, cell, id=name, marks=[pytest.mark.slow] * slow)
        begun.add(case.subject)


KERNELS = kernels("cpu")


@pytest.mark.parametrize(("case", "cell"), list(cells()))
def test_it_holds(case, cell, device):
    with unforgiving():
        row = case.check(cell, device)
    if row["status"].startswith("unavailable"):
        pytest.skip(row["status"])
    assert row["status"] == "ok", row


@pytest.fixture
def blocks_of_a_gpu() -> Iterator[None]:
    """The march has larger blocks where it is interpreted; no other kernel has."""
    written = {x: inspect.getsource(importlib.import_module(f"{x}.gpu")) for x in kernels("gpu")}
    sized = [name for name, source in written.items() if "interpreted()" in source]
    assert sized == ["methods.kernels.march"]
    module = importlib.import_module("methods.kernels.march.gpu")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatch, "interpreted", lambda: False)
        importlib.reload(module)
    yield
    importlib.reload(module)


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="here all cases have them")
@pytest.mark.skipif(bool(availability()["gpu"]), reason="Triton has no build for this platform")
@pytest.mark.usefixtures("blocks_of_a_gpu")
def test_it_holds_in_the_blocks_of_a_gpu():
    (case,) = (x for x in CASES if (x.subject, x.name) == ("march", "inside and outside"))
    row = case.check(("gpu", "fp32"), "cpu")
    assert row["status"] == "ok", row


@pytest.mark.parametrize(
    "case",
    [case for case in QUICK if isinstance(case.error, Difference)],
    ids=lambda case: f"{case.subject}: {case.name}",
)
def test_zeros_for_any_result_exceed_the_tolerance(case):
    right = case.error.prepare("cpu")("reference")
    for index, result in enumerate(right):
        if result.count_nonzero():
            nothing = *right[:index], torch.zeros_like(result), *right[index + 1 :]
            error, tolerance = nearest(nothing, right, case.error.tolerances())
            assert error > tolerance, index


def test_no_two_cases_have_the_same_name():
    names = [(case.subject, case.name) for case in CASES]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_has_cases_for_all_its_backends(kernel):
    module = importlib.import_module(f"{kernel}.cases")
    cells = {cell for case in module.cases() for cell in case.tolerances}
    assert {backend for backend, _ in cells} == set(dispatch.served(kernel))


@pytest.mark.parametrize("kernel", KERNELS)
def test_backends_have_the_same_signatures(kernel):
    names = [name for name in dispatch.served(kernel) if not availability()[name]]
    versions = [vars(importlib.import_module(f"{kernel}.{name}")) for name in names]
    shared = set.intersection(*map(set, versions))
    public = [name for name in shared if name[0] != "_" and inspect.isfunction(versions[0][name])]
    assert public
    for name in public:
        assert len({inspect.signature(of[name], eval_str=True) for of in versions}) == 1, name
