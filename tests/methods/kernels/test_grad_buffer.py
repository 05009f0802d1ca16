"""Tables whose gradient is collected in a buffer beside autograd."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from methods.kernels.corner_gather import corner_gather
from methods.plenoctree.kernels.voxel_light import shade_voxels

RANDOM = torch.Generator().manual_seed(0)
WEIGHTS = torch.rand(9, 8, generator=RANDOM)
VOXEL, RAY = (torch.randint(4, (9,), generator=RANDOM).int() for _ in range(2))
CORNERS = torch.randint(20, (4, 8), generator=RANDOM).int()
DIRECTIONS = torch.nn.functional.normalize(torch.randn(4, 3, generator=RANDOM), dim=1)

Reads = Callable[[Tensor, Tensor | None, str], Tensor]
KERNELS: dict[str, tuple[tuple[int, ...], Reads]] = {
    "gather": (
        (20, 4),
        lambda table, buffer, backend: corner_gather(
            table, CORNERS, VOXEL, WEIGHTS, grad_buffer=buffer, backend=backend
        ),
    ),
    "shade_voxels": (
        (4, 9, 3),
        lambda table, buffer, backend: shade_voxels(
            table, VOXEL, RAY, DIRECTIONS, grad_buffer=buffer, backend=backend
        ),
    ),
}


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_buffer_gets_the_gradient_whether_or_not_the_table_asks_for_one(
    kernel: str, backend: str
) -> None:
    shape, read = KERNELS[kernel]
    table = torch.rand(shape, generator=torch.Generator().manual_seed(1)).requires_grad_()
    (gradient,) = torch.autograd.grad(read(table, None, backend).sum(), table)
    for asked in (False, True):
        buffer = torch.ones(shape)
        read(table.detach().requires_grad_(asked), buffer, backend).sum().backward()
        torch.testing.assert_close(buffer, gradient + 1)
