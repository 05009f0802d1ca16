"""Every backend against the reference, on the cases that stand beside the kernels."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import pytest
import torch

import methods.kernels
from bench.types import Log
from methods.kernels import BACKENDS, availability, benchmark, resolve
from methods.kernels.benchmark import all_cases
from methods.kernels.case import Case, Prepared, largest_error

CASES = [case for case in all_cases() if not case.timed]
KERNELS = (
    "adam",
    "composite",
    "depthwise",
    "lift",
    "encode",
    "march",
    "spherical",
    "splat",
    "warp",
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.kernel}: {case.name}")
def test_backends_agree_with_the_reference(case: Case, device: str) -> None:
    prepared = case.prepare(device)
    got = tuple(result.cpu() for result in prepared.call(resolve("auto", device)))
    assert largest_error(got, case.prepare("cpu").call("reference")) <= prepared.tolerance


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.kernel}: {case.name}")
def test_zeros_for_results_exceed_the_tolerance(case: Case) -> None:
    prepared = case.prepare("cpu")
    right = prepared.call("reference")
    nothing = tuple(torch.zeros_like(result) for result in right)
    assert largest_error(nothing, right) > prepared.tolerance or not any(
        result.count_nonzero() for result in right
    )


def test_a_nan_is_an_infinite_error() -> None:
    assert largest_error((torch.tensor([torch.nan]),), (torch.ones(1),)) == torch.inf


@pytest.mark.parametrize("timed", [False, True])
def test_a_kernel_that_is_wrong_on_any_case_gets_no_time(
    timed: bool, monkeypatch: pytest.MonkeyPatch, quiet_log: Log
) -> None:
    def wrong_at_zero(device: str) -> Prepared:
        return Prepared(lambda backend: (torch.tensor([float(backend == "cpu")]),), 0.5)

    def right(device: str) -> Prepared:
        return Prepared(lambda backend: (torch.zeros(1),), 0.5)

    cases = [
        Case("fake", "large", "fp32", 1000, right, timed=True),
        Case("fake", "no sample", "fp32", 0, wrong_at_zero, timed=timed),
    ]
    monkeypatch.setattr(benchmark, "all_cases", lambda: cases)
    found = benchmark.main_rows("fake", 2, quiet_log)
    rows = {row["backend"]: row for row in found if row["case"] == "large"}
    assert rows["reference"]["status"] == "ok"
    assert rows["reference"]["ratio"] == 1
    assert rows["cpu"]["status"] == "wrong: no sample"
    assert "ms" not in rows["cpu"]


@pytest.mark.parametrize("kernel", KERNELS)
def test_backends_have_the_same_signature(kernel: str) -> None:
    folder = Path(methods.kernels.__file__).parent / kernel
    usable = [name for name in BACKENDS if not availability()[name]]
    names = [path.stem for path in folder.glob("*.py") if path.stem in usable]
    assert {"reference", "cpu"} <= set(names)
    public = {"adam": "sparse_adam_", "spherical": "spherical_harmonics"}.get(kernel, kernel)
    signatures = {
        inspect.signature(
            getattr(importlib.import_module(f"methods.kernels.{kernel}.{name}"), public)
        )
        for name in names
    }
    assert len(signatures) == 1


def test_every_kernel_folder_has_cases() -> None:
    folders = {path.parent.name for path in Path(methods.kernels.__file__).parent.glob("*/cpu.py")}
    assert folders == set(KERNELS)
    assert {case.kernel.split()[0] for case in CASES} == set(KERNELS)


def test_reference_and_cpu_are_usable_everywhere() -> None:
    assert availability()["reference"] == availability()["cpu"] == ""
