"""What all Triton kernels share. Only files named `gpu.py` import Triton.

On a machine without a GPU they run in Triton's interpreter, slowly, where the environment says
TRITON_INTERPRET=1: the tests do so.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
from torch import Tensor


def launch(
    kernel: triton.JITFunction, grid: tuple[int, ...], *arguments: Any, **options: Any
) -> None:
    """Run `kernel` on `grid` unless that is empty, on the device of the first argument, a tensor.

    Products and sums are not contracted: a sum of a product is rounded twice, as everywhere else.
    """
    if all(grid):
        with torch.cuda.device_of(arguments[0]):
            kernel[grid](*arguments, enable_fp_fusion=False, **options)


def check_types(name: str, tensor: Tensor, *served: torch.dtype) -> None:
    """Raise ValueError unless `tensor` is of one of the types that are `served`."""
    if tensor.dtype not in served:
        expected = " or ".join(str(dtype).removeprefix("torch.") for dtype in served)
        raise ValueError(
            f"backend 'gpu' expects {name} of {expected}, got {tensor.dtype}: use "
            "backend='reference'"
        )
