"""A case: inputs on which every backend of a kernel must agree with the reference.

The cases of a kernel stand in its `cases.py`, once, and serve the tests and the benchmark; what is
held against exact answers at the extremes stands in its `stress.py`. Tolerances are derived from
the arithmetic, in terms of the unit roundoff u of the type that the result is computed in, and
stated beside the case.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

DTYPES = {
    "fp64": torch.float64,
    "fp32": torch.float32,
    "fp16": torch.float16,
    "bf16": torch.bfloat16,
}

U32 = 2.0**-24
"""Unit roundoff of float32."""

U16 = 2.0**-8
"""Unit roundoff of bfloat16, and its ulp from 1/2 to 1: two nearly equal numbers below 1 may round
to neighbours."""


@dataclass(frozen=True)
class Prepared:
    """Inputs in place: `call(backend)` runs the kernel on them, each result within `tolerance`.

    `tolerance` bounds |result - reference| in absolute terms, for all outputs of `call`.
    """

    call: Callable[[str], tuple[Tensor, ...]]
    tolerance: float


@dataclass(frozen=True)
class Case:
    """One case of a kernel.

    Attributes:
        kernel: what is computed, with its direction ("encode", "encode backward").
        name: what is special about the inputs.
        dtype: what the kernel reads.
        items: how many samples, rays or entries one call handles.
        prepare: makes the inputs on a device.
        timed: large enough that its throughput says something.
    """

    kernel: str
    name: str
    dtype: str
    items: int
    prepare: Callable[[str], Prepared]
    timed: bool = False


def on_backends(units: float, *precisions: str) -> dict[tuple[str, str], float]:
    """Cells of a `bench.stress.StressCase` that is right to within `units` u: in fp32 by the
    reference and by the backend of the CPU, in further `precisions` by the reference, which alone
    has them."""
    cells = [("reference", "fp32"), ("cpu", "fp32"), *(("reference", p) for p in precisions)]
    return {cell: units * torch.finfo(DTYPES[cell[1]]).eps / 2 for cell in cells}


def largest_error(results: tuple[Tensor, ...], reference: tuple[Tensor, ...]) -> float:
    """Largest |result - reference| of all outputs; inf where shapes or non-finite values differ."""
    worst = 0.0
    for got, want in zip(results, reference, strict=True):
        if got.shape != want.shape:
            return torch.inf
        got, want = got.detach().double(), want.detach().double()
        same = (got == want) | (got.isnan() & want.isnan())
        error = torch.where(same, 0, (got - want).abs()).nan_to_num(nan=torch.inf)
        worst = max(worst, error.max().item() if error.numel() else 0.0)
    return worst
