"""The kernels of the GPU where their cases say nothing: on a GPU, else in Triton's interpreter."""

import importlib
import inspect
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bench.case import U32, largest_error
from methods.checks import kernels
from methods.kernels import availability
from methods.kernels.adam import AdamState, sparse_adam_
from methods.kernels.composite import composite, visibility
from methods.kernels.encode import HashGrid, encode
from methods.kernels.types import Intervals
from tests.common import refusal, seeded

pytestmark = pytest.mark.skipif(
    bool(availability()["gpu"]), reason="Triton has no build for this platform"
)
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"


def test_what_is_not_a_number_shows_and_what_is_behind_it_does_not():
    """On a ray of several blocks of 64 samples; an opaque sample hides what is behind, too."""
    offsets = torch.tensor([0, 200, 202], device=DEVICE)
    sigma = torch.full((202,), 0.01, device=DEVICE)
    sigma[10], sigma[200] = torch.nan, torch.inf
    intervals = Intervals(sigma, torch.ones_like(sigma), offsets)
    seen = visibility(sigma, intervals, backend="gpu")
    found = seen.weights.cpu()
    assert (found[:10] > 0).all()
    assert found[10].isnan()
    assert found[11:].tolist() == [0] * 189 + [1, 0]
    assert seen.counts.tolist() == [11, 1]
    pixels = composite(sigma, torch.ones_like(sigma)[:, None], intervals, backend="gpu")
    assert pixels.alpha[0].isnan()
    assert pixels.alpha[1] == 1


def test_what_is_not_contiguous_is_read_all_the_same():
    generator = seeded(0)
    grid = HashGrid(levels=2, features=2, log2_table=6, n_min=4, n_max=20)
    positions = torch.rand(3, 50, generator=generator).to(DEVICE).T
    table = torch.rand(2, grid.entries, generator=generator).to(DEVICE).T.requires_grad_()
    gradients = [
        torch.autograd.grad(encode(positions, table, grid, backend=backend).sum(), table)
        for backend in ("gpu", "reference")
    ]
    # As in the cases of `encode backward`, of at most 50 samples.
    fractions = 3 * 2 * U32 * grid.n_max
    assert largest_error(*gradients) <= 6 * 50**0.5 * (fractions + 50 * U32)


def test_a_thin_haze_keeps_its_light_to_the_last_digits():
    """1 - exp(-tau) of a tau far below 1, which a difference of float32 numbers does not have."""
    sigma = torch.logspace(-30, 0, 61, device=DEVICE)
    offsets = torch.arange(62, device=DEVICE)
    intervals = Intervals(sigma, torch.full_like(sigma, 0.25), offsets)
    found = visibility(sigma, intervals, backend="gpu").weights.double().cpu()
    exact = -torch.expm1(-(0.25 * sigma.double())).cpu()
    # The series has twelve operations; 1 - exp is off by itself and 2 ulp of an exp below 1.
    assert ((found - exact).abs() / exact).max() <= (12 + 3 / 0.06) * U32


@pytest.mark.slow
@pytest.mark.skipif(platform.system() != "Linux", reason="Triton brings its assembler for Linux")
def test_every_kernel_compiles_for_gpus_that_are_not_here_without_spills(tmp_path):
    environment = {name: text for name, text in os.environ.items() if name != "TRITON_INTERPRET"}
    done = subprocess.run(
        [sys.executable, "-P", Path(__file__).with_name("compiled.py")],
        env=environment | {"TRITON_CACHE_DIR": str(tmp_path), "TRITON_DUMP_PTXAS_LOG": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    compiled = set(done.stdout.splitlines())
    for name in kernels("gpu"):
        source = inspect.getsource(importlib.import_module(f"{name}.gpu"))
        launched = {f"{name}.gpu {kernel}" for kernel in re.findall(r"launch\(\s*(_\w+)", source)}
        assert launched <= compiled
    spilled = re.findall(r"(\d+) bytes spill", done.stdout)
    assert set(spilled) == {"0"}


def test_what_it_does_not_serve_is_refused():
    grid = HashGrid(levels=1, features=2, log2_table=3, n_min=2, n_max=2)
    table = torch.zeros(2, 8, device=DEVICE).T
    positions = torch.rand(2, 3, dtype=torch.float64, device=DEVICE)
    with refusal("expects positions of float32", ValueError):
        encode(positions, table, grid, backend="gpu")
    with refusal("expects table to be contiguous", ValueError):
        sparse_adam_(table, table, AdamState.like(table), 0.1, backend="gpu")
