"""Functions shared by all Triton kernels. In this package only files named `gpu.py` import Triton.

On a machine without a GPU, the kernels run (slowly) in Triton's interpreter if TRITON_INTERPRET=1
is set in the environment, as the tests do.
"""

from pathlib import Path
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor


def launch(
    kernel: triton.JITFunction, grid: tuple[int, ...], *arguments: Any, **options: Any
) -> None:
    """Run `kernel` on `grid`, unless that is empty, on the device of the first argument, a tensor.
    Multiply-adds are not fused, so that the march gives the same bits as the reference. A division
    by `/` is within 2 ulp, by `tl.div_rn` exactly rounded. An exponential is 2^(x log2 e): within
    2 + 1.17 |x| ulp."""
    if all(grid):
        with torch.cuda.device_of(arguments[0]):
            kernel[grid](*arguments, enable_fp_fusion=False, **options)


def cache_folder() -> Path:
    """Where Triton keeps what it has compiled."""
    return Path(triton.knobs.cache.dir)


def check_float32(**tensors: Tensor) -> None:
    """Raise ValueError unless all are of float32."""
    for name, tensor in tensors.items():
        if tensor.dtype != torch.float32:
            raise ValueError(
                f"backend 'gpu' expects {name} of float32, got {tensor.dtype}: use "
                "backend='reference'"
            )


@triton.jit
def vector(vectors, i, there):
    """x, y and z of `vectors` [N, 3] at `i`; 0 where the mask `there` is false."""
    return (
        tl.load(vectors + 3 * i, mask=there, other=0.0),
        tl.load(vectors + 3 * i + 1, mask=there, other=0.0),
        tl.load(vectors + 3 * i + 2, mask=there, other=0.0),
    )


@triton.jit
def opacity(tau):
    """1 - exp(-tau), by its series where the difference would lose digits."""
    series = tau * (1 - tau / 2 * (1 - tau / 3 * (1 - tau / 4 * (1 - tau / 5))))
    return tl.where(tau < 0.06, series, 1 - tl.exp(-tau))
