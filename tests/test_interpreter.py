"""What the tests ask of Triton's interpreter is found where it is, and nowhere else."""

import pytest
import torch

from methods.kernels import availability
from tests.common import refusal
from tests.interpreter import unforgiving

if availability()["gpu"] or torch.cuda.is_available():
    pytest.skip("nothing is interpreted here", allow_module_level=True)

import triton
import triton.language as tl


@triton.jit
def _doubled(out, x, total, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    tl.store(out + i, 2 * tl.load(x + i, mask=i < total, other=0.0), mask=i < total)


@triton.jit
def _first(out, program):
    """Each program leaves its number where it was the first."""
    old = tl.load(out)
    tl.store(program + tl.program_id(0), old)
    tl.store(out, old + 1)


@triton.jit
def _summed(out, x, BLOCK: tl.constexpr):
    tl.atomic_add(out, tl.sum(tl.load(x + tl.program_id(0) * BLOCK + tl.arange(0, BLOCK))))


def test_a_kernel_that_leaves_its_tensors_is_refused():
    x, out = torch.ones(8)[:7], torch.zeros(16)
    with unforgiving():
        _doubled[2,](out, x, 7, BLOCK=4)
        assert out.tolist() == [2.0] * 7 + [0.0] * 9
        with refusal("outside of all tensors", Exception):
            _doubled[3,](out, x, 9, BLOCK=4)


def test_programs_that_need_an_order_are_a_race():
    with unforgiving(), refusal("race", RuntimeError):
        _first[4,](torch.zeros(1), torch.zeros(4))


def test_atomic_sums_are_none():
    out = torch.zeros(1)
    with unforgiving():
        _summed[4,](out, torch.ones(16), BLOCK=4)
    assert out.item() == 16
