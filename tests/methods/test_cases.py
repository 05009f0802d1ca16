"""All cases but those that take more than a moment."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import pytest
import torch

import methods.kernels
from bench.case import Case, Cell, Difference, largest_error
from methods.checks import found
from methods.kernels import BACKENDS, availability

CASES = found("cases")
QUICK = [case for case in CASES if not (case.slow or case.timed)]
DEAR = (
    *("march", "voxel_walk", "render_voxels", "warp"),
    *("composite backward", "encode backward", "gaussian blending backward"),
    *("grouped linear", "grouped linear backward", "ssim", "ssim backward"),
    *("space_to_depth", "space_to_depth backward"),
)
"""Subjects whose kernels of the GPU have loops or many operations: interpreted, they take long."""


def marks(case: Case, cell: Cell) -> list[pytest.MarkDecorator]:
    """Of a dear kernel that is interpreted `make test` takes the first case."""
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
KERNELS = sorted(
    path.parent.name for path in Path(methods.kernels.__file__).parent.glob("*/cpu.py")
)


@pytest.fixture(autouse=True)
def wide_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interpreted kernel of the GPU costs the same for a block of any size."""
    if not (torch.cuda.is_available() or availability()["gpu"]):
        monkeypatch.setattr("methods.kernels.march.gpu.BLOCK", 256)


@pytest.mark.parametrize(("case", "cell"), CELLS)
def test_it_holds(case: Case, cell: Cell, device: str) -> None:
    row = case.check(cell, device)
    if row["status"].startswith("unavailable"):
        pytest.skip(row["status"])
    assert row["status"] == "ok", row


@pytest.mark.parametrize(
    "case",
    [case for case in QUICK if isinstance(case.error, Difference)],
    ids=lambda case: f"{case.subject}: {case.name}",
)
def test_zeros_for_results_exceed_the_tolerance(case: Case) -> None:
    right = case.error.prepare("cpu")("reference")
    nothing = tuple(torch.zeros_like(result) for result in right)
    tolerance = max(case.tolerances.values())
    assert largest_error(nothing, right) > tolerance or not any(
        result.count_nonzero() for result in right
    )


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
    module = importlib.import_module(f"methods.kernels.{kernel}.cases")
    cells = {cell for case in module.cases() for cell in case.tolerances}
    folder = Path(methods.kernels.__file__).parent / kernel
    assert {backend for backend, _ in cells} == {
        name for name in BACKENDS if (folder / f"{name}.py").exists()
    }


NAMES = {
    "adam": "sparse_adam_",
    "corner_gather": "gather",
    "gaussian_blending": "blend",
    "gaussian_projection": "project_gaussians",
    "grouped_mlp": "grouped_linear",
    "spherical": "spherical_harmonics",
    "voxel_shading": "shade_voxels",
    "voxel_walk": "walk",
}
"""What a kernel is called where it is not called as its folder."""


@pytest.mark.parametrize("kernel", KERNELS)
def test_backends_have_the_same_signature(kernel: str) -> None:
    folder = Path(methods.kernels.__file__).parent / kernel
    usable = [name for name in BACKENDS if not availability()[name]]
    names = [path.stem for path in folder.glob("*.py") if path.stem in usable]
    assert {"reference", "cpu"} <= set(names)
    public = NAMES.get(kernel, kernel)
    signatures = {
        inspect.signature(
            getattr(importlib.import_module(f"methods.kernels.{kernel}.{name}"), public)
        )
        for name in names
    }
    assert len(signatures) == 1


def test_reference_and_cpu_are_usable_everywhere() -> None:
    assert availability()["reference"] == availability()["cpu"] == ""
