"""What the numba backends share.

numba caches compiled code by the file of the calling function alone: after a change of
a function of this file, or of a constant that such a file imports from another (`PRIMES`, `TAPS`),
remove the `__pycache__` of its callers.

The process that compiles a function runs another copy of it than the processes that load it from
the cache: LLVM has optimised one of them twice. Where it may choose how to round, the copies can
differ in the last bit, and a training then does not repeat. So `fastmath` allows "contract" where
there is one way to contract, as in a sum of products, and "reassoc" where both copies were seen to
give the same bits in all cases of the kernel.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import torch
from numba import njit

from methods.kernels.march import PARALLEL

f32, i32, u32 = np.float32, np.int32, np.uint32


def follow_torch_threads() -> None:
    """Run the kernels on as many threads as torch uses, up to those that numba has started."""
    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    if torch.get_num_threads() != threads:  # starting its own, numba changed those of OpenMP
        torch.set_num_threads(threads)


@njit(cache=True)
def sigmoid(x):
    """1 / (1 + e^-x) of a float32."""
    return f32(1) / (f32(1) + f32(math.exp(-x)))


@njit(cache=True)
def slope(direction):
    """t by length along an axis; 0 for a ray that does not move along it."""
    return f32(1) / direction if abs(direction) >= PARALLEL else f32(0)


@njit(cache=True)
def pack_bf16(low, high):
    """Two float32 rounded to nearest even bfloat16, in the low and high half of a word."""
    return u32(u32(_round_bits(low) >> u32(16)) | u32(_round_bits(high) & u32(0xFFFF0000)))


@njit(cache=True)
def _round_bits(value):
    """Bits of a float32 after rounding; the upper half is the bfloat16."""
    bits = f32(value).view(np.uint32)
    tie_to_even = u32(u32(bits >> u32(16)) & u32(1))
    return u32(u32(bits + u32(0x7FFF)) + tie_to_even)
