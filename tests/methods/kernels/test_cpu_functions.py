"""Functions of all kernels for the CPU: the exponential against float64, rounding against torch."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numba import njit

from bench.case import U32
from methods.kernels.cpu import EDGE, exp, pack_bf16


@njit
def _all(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(x)):
        out[i] = exp(x[i])


def test_it_is_exact_to_three_roundings_between_its_ends_and_held_beyond_them() -> None:
    x = np.linspace(-EDGE, EDGE, 100_001, dtype=np.float32)
    x = np.concatenate((x, np.float32([-math.inf, math.inf, math.nan])))
    out = np.empty_like(x)
    _all(x, out)
    assert np.abs(out[:-3] / np.exp(x[:-3].astype(np.float64)) - 1).max() <= 3 * U32
    assert out[-3:-1].tolist() == [out[0], out[-4]]
    assert math.isnan(out[-1])


BITS = [0x7FFFFFFF, 0xFFFFFFFF, 0x7F800001, 0x7FC00000, 0x7F800000, 0xFF800000, 0x7F7FFFFF]
"""Those of four NaN, +inf, -inf and the largest number, which rounds to +inf."""


@pytest.mark.parametrize("bits", [*BITS, 0x3F808000, 0x3F818000, 0x3F808001, 0x80000000, 1])
def test_numbers_are_rounded_to_bfloat16_as_torch_does(bits: int) -> None:
    number = torch.tensor([bits]).to(torch.uint32).view(torch.float32)
    other = torch.tensor([1.0])
    for pair in ((number, other), (other, number)):
        word = pack_bf16(*(x.numpy()[0] for x in pair))
        got = torch.tensor([int(word)]).to(torch.uint32).view(torch.bfloat16)
        assert torch.equal(got.nan_to_num(), torch.cat(pair).bfloat16().nan_to_num())
        assert torch.equal(got.isnan(), torch.cat(pair).isnan())
