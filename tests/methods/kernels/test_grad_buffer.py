"""Tables whose gradient is collected in a buffer beside autograd."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from methods.kernels.corner_gather import gather
from methods.kernels.voxel_shading import shade_voxels

RANDOM = torch.Generator().manual_seed(0)
WEIGHTS = torch.rand(9, 8, generator=RANDOM)
VOXEL, RAY = (torch.randint(4, (9,), generator=RANDOM).int() for _ in range(2))
CORNERS = torch.randint(20, (4, 8), generator=RANDOM).int()
DIRECTIONS = torch.nn.functional.normalize(torch.randn(4, 3, generator=RANDOM), dim=1)

Reads = Callable[[Tensor, Tensor, str], Tensor]
KERNELS: dict[str, tuple[tuple[int, ...], Reads]] = {
    "gather": (
        (20, 4),
        lambda table, buffer, backend: gather(
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
def test_a_buffer_is_filled_whether_or_not_the_table_asks_for_a_gradient(
    kernel: str, backend: str
) -> None:
    shape, read = KERNELS[kernel]
    table = torch.rand(shape, generator=torch.Generator().manual_seed(1))
    buffers = [torch.zeros(shape), torch.zeros(shape)]
    for asked, buffer in zip((False, True), buffers, strict=True):
        read(table.clone().requires_grad_(asked), buffer, backend).sum().backward()
    assert buffers[0].any()
    assert torch.equal(*buffers)
