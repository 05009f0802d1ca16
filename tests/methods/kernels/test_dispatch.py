"""Which backend serves a call."""

import subprocess
import sys

import pytest
import torch

from bench.errors import Unavailable
from methods.kernels import availability, dispatch, resolve
from tests.common import refusal


def test_auto_goes_by_the_device():
    assert resolve("auto", "cpu") == "cpu"
    tried = torch.cuda.is_available() and not dispatch.interpreted()
    assert resolve("auto", "cuda:0") == ("auto" if tried else "reference")


def test_a_backend_that_is_unknown_or_of_another_device_is_refused():
    with refusal(r"'refrence'.*did you mean 'reference'", Unavailable):
        resolve("refrence", "cpu")
    with refusal("serves CPU tensors, these are on 'cuda'", Unavailable):
        resolve("cpu", "cuda")


@pytest.mark.skipif(torch.cuda.is_available(), reason="here it can be used")
def test_backend_that_cannot_be_used_says_why(monkeypatch):
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    availability.cache_clear()
    with refusal(r"sees no GPU|not installed", Unavailable):
        resolve("gpu", "cuda")
    availability.cache_clear()


@pytest.mark.parametrize("backend", ["auto", "cpu"])
def test_a_kernel_without_a_version_is_computed_by_its_reference(backend, monkeypatch):
    monkeypatch.setattr(dispatch, "served", lambda kernel: ("reference",))
    kernel, device = "methods.kernels.shade", torch.device("cpu")
    assert dispatch.implementation(kernel, backend, device).__name__ == f"{kernel}.reference"


def test_an_interpreted_backend_is_not_compiled(monkeypatch):
    monkeypatch.setattr(dispatch, "resolve", lambda backend, device: backend)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert dispatch.compiled("cpu") == ["reference", "cpu"]
    monkeypatch.delenv("TRITON_INTERPRET")
    assert dispatch.compiled("cpu") == ["reference", "cpu", "gpu"]


def test_torch_keeps_its_threads_when_the_first_kernel_starts_its_own():
    program = """
import torch
from methods.kernels.shade import shade

torch.set_num_threads(1)
shade(torch.rand(100, 1, 3), torch.rand(100, 3), backend="cpu")
print(torch.get_num_threads())
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "1\n"), done.stderr
