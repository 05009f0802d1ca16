"""Adam that skips entries without gradient (Kingma & Ba 2015; sparse as in tiny-cuda-nn).

If no feature of a table entry has a gradient, the entry keeps its value and moments. Dense Adam
would keep moving it by momentum, and would read and write the whole table every step.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Self

import torch
from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.encode import HashGrid, SampleGradients

BETAS = (0.9, 0.99)
EPS = 1e-15


@dataclass
class AdamState:
    """First and second moment of a table [entries, F] and each entry's own step counter."""

    first: Tensor
    second: Tensor
    steps: Tensor
    gradient: Tensor | None = None  # where a GPU adds up gradients: 0 between steps

    @classmethod
    def like(cls, table: Tensor) -> Self:
        """A fresh state for `table`."""
        return cls(
            torch.zeros_like(table),
            torch.zeros_like(table),
            torch.zeros(len(table), dtype=torch.int32, device=table.device),
        )

    def tensors(self) -> dict[str, Tensor]:
        """The state, for a checkpoint."""
        return {"first": self.first, "second": self.second, "steps": self.steps}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `tensors` returned."""
        device = self.first.device
        self.first, self.second, self.steps = (tensors[x].to(device) for x in self.tensors())


@cache
def corrections() -> Tensor:
    """The bias corrections 1 / (1 - beta^n) of both `BETAS` for n = 0 (unused), 1, ...: [2, N]. The
    table ends where float32 rounds both to 1."""
    last = math.ceil(math.log(2.0**-25) / math.log(max(BETAS)))
    powers = torch.tensor(BETAS, dtype=torch.float64)[:, None] ** torch.arange(last + 1)
    return (1 / (1 - powers)).float()


def sparse_adam_(
    table: Tensor, grad: Tensor, state: AdamState, rate: float, *, backend: str = "auto"
) -> None:
    """Update in place the entries of `table` [entries, F] with a non-zero `grad`; clear `grad`. The
    bias correction uses the entry's own step count."""
    check_shape("grad", grad, *table.shape)
    _check(table, state)
    implementation(__name__, backend, table.device).sparse_adam_(table, grad, state, rate)


def hash_adam_(
    table: Tensor,
    gradients: SampleGradients,
    grid: HashGrid,
    state: AdamState,
    rate: float,
    *,
    packed: Tensor | None = None,
    backend: str = "auto",
) -> None:
    """`sparse_adam_` for the hash table of `grid`, with the sum of its `gradients`; clear them.
    `packed`, the bfloat16 copy of the table (`encode.pack`), is updated, too, if given."""
    check_shape("table", table, grid.entries, grid.features)
    _check(table, state)
    if packed is not None:
        check_shape("packed", packed, grid.entries)
    if gradients:
        positions, grad = gradients.joined()
        check_shape("positions", positions, None, 3)
        check_shape("gradients", grad, len(positions), grid.channels)
        kernel = implementation(__name__, backend, table.device)
        kernel.hash_adam_(table, positions, grad, grid, state, rate, packed)
    gradients.clear()


def _check(table: Tensor, state: AdamState) -> None:
    check_shape("first", state.first, *table.shape)
    check_shape("second", state.second, *table.shape)
    check_shape("steps", state.steps, len(table))
