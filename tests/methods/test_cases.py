"""All cases but those that take more than a moment."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import methods.kernels
from bench.case import Case, Cell, Difference, nearest
from methods.checks import found, kernels
from methods.kernels import availability, dispatch

CASES = found("cases")
QUICK = [case for case in CASES if case.quick]
DEAR = ("march", "composite backward", "encode backward")
"""Subjects whose kernels of the GPU have loops or many operations: interpreted, they take long."""


def marks(case: Case, cell: Cell) -> list[pytest.MarkDecorator]:
    """Of a kernel that takes long in the interpreter, `make test` takes the first case."""
    interpreted = cell[0] == "gpu" and not torch.cuda.is_available()
    first = next(other for other in QUICK if other.subject == case.subject)
    slow = interpreted and case.subject in DEAR and case is not first
    return [pytest.mark.slow] if slow else []


CELLS = [
    pytest.param(
        case, cell, id=f"{case.subject}: {case.name}: {' '.join(cell)}", marks=marks(case, cell)
    )
    for case in QUICK
    for cell in case.tolerances
]
KERNELS = kernels("cpu")


@pytest.mark.parametrize(("case", "cell"), CELLS)
def test_it_holds(case: Case, cell: Cell, device: str) -> None:
    row = case.check(cell, device)
    if row["status"].startswith("unavailable"):
        pytest.skip(row["status"])
    assert row["status"] == "ok", row


MANY_BLOCKS = {"methods.kernels.march": {"inside and outside"}}
"""Kernels whose blocks are larger where they are interpreted, and cases of several small blocks."""


@pytest.fixture
def blocks_of_a_gpu(kernel: str) -> Iterator[None]:
    module = importlib.import_module(f"{kernel}.gpu")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dispatch, "interpreted", lambda: False)
        importlib.reload(module)
    yield
    importlib.reload(module)


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="here all cases have them")
@pytest.mark.usefixtures("blocks_of_a_gpu")
@pytest.mark.parametrize("kernel", MANY_BLOCKS)
def test_it_holds_in_the_blocks_of_a_gpu(kernel: str) -> None:
    if reason := availability()["gpu"]:
        pytest.skip(reason)
    cases = importlib.import_module(f"{kernel}.cases").cases()
    chosen = [case for case in cases if case.name in MANY_BLOCKS[kernel]]
    for case in chosen:
        for cell in case.tolerances:
            if cell[0] == "gpu":
                row = case.check(cell, "cpu")
                assert row["status"] == "ok", row


def test_no_kernel_with_blocks_of_its_own_for_the_interpreter_is_left_out() -> None:
    sized = {
        kernel
        for kernel in kernels("gpu")
        if "interpreted()" in inspect.getsource(importlib.import_module(f"{kernel}.gpu"))
    }
    assert sized == set(MANY_BLOCKS)


@pytest.mark.parametrize(
    "case",
    [case for case in QUICK if isinstance(case.error, Difference)],
    ids=lambda case: f"{case.subject}: {case.name}",
)
def test_zeros_for_any_result_exceed_the_tolerance(case: Case) -> None:
    right = case.error.prepare("cpu")("reference")
    for index, result in enumerate(right):
        if result.count_nonzero():
            nothing = *right[:index], torch.zeros_like(result), *right[index + 1 :]
            error, tolerance = nearest(nothing, right, case.error.tolerances())
            assert error > tolerance, index


def test_no_two_cases_have_the_same_name() -> None:
    names = [(case.subject, case.name) for case in CASES]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("name", ["cases", "experiments"])
def test_every_file_of_checks_has_some(name: str) -> None:
    root = Path(methods.kernels.__file__).parents[2]
    paths = [path for top in ("bench", "methods") for path in (root / top).rglob(f"{name}.py")]
    assert paths
    for path in paths:
        module = ".".join(path.relative_to(root).with_suffix("").parts)
        assert getattr(importlib.import_module(module), name)()


@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_has_cases_for_all_its_backends(kernel: str) -> None:
    module = importlib.import_module(f"{kernel}.cases")
    cells = {cell for case in module.cases() for cell in case.tolerances}
    assert {backend for backend, _ in cells} == set(dispatch.served(kernel))


NAMES = {
    "adam": "sparse_adam_ hash_adam_",
    "segments": "segment_weights render_segments",
    "blending": "blend",
    "projection": "project_gaussians",
    "grouped_mlp": "grouped_linear",
    "spherical": "spherical_harmonics",
    "voxel_light": "render_voxels shade_voxels",
    "voxel_walk": "walk",
}
"""What a kernel is called where it is not called as its folder."""


@pytest.mark.parametrize("kernel", KERNELS)
def test_backends_have_the_same_signature(kernel: str) -> None:
    names = [name for name in dispatch.served(kernel) if not availability()[name]]
    assert {"reference", "cpu"} <= set(names)
    modules = [importlib.import_module(f"{kernel}.{name}") for name in names]
    short = kernel.rpartition(".")[2]
    for public in NAMES.get(short, short).split():
        assert len({inspect.signature(getattr(module, public)) for module in modules}) == 1


def test_reference_and_cpu_are_usable_everywhere() -> None:
    assert availability()["reference"] == availability()["cpu"] == ""
