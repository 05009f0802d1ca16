"""Which backend serves a call."""

from __future__ import annotations

import pytest

from bench.errors import Unavailable
from methods.kernels import resolve


def test_auto_goes_by_the_device() -> None:
    assert resolve("auto", "cpu") == "cpu"
    assert resolve("auto", "cuda:0") == "reference"


def test_unknown_backend_names_the_nearest() -> None:
    with pytest.raises(Unavailable, match=r"'refrence'.*did you mean 'reference'"):
        resolve("refrence", "cpu")


def test_backend_that_cannot_be_used_says_why() -> None:
    with pytest.raises(Unavailable, match="no GPU kernels yet"):
        resolve("gpu", "cuda")


def test_cpu_backend_refuses_tensors_of_another_device() -> None:
    with pytest.raises(Unavailable, match="serves CPU tensors, these are on 'cuda'"):
        resolve("cpu", "cuda")
