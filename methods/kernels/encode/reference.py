"""Hash-grid encoding in plain torch, differentiable in the table and in the positions."""

import torch
from torch import Tensor

from bench.types import TwoTensors
from methods.kernels.encode import PRIMES, HashGrid


def encode(positions: Tensor, table: Tensor, grid: HashGrid, packed: Tensor | None) -> Tensor:
    inside = torch.where(positions > 0, positions, 0).clamp(max=1)
    found = []
    for level in range(grid.levels):
        entries, weights = corners(inside, grid, level)
        values = table[entries]  # [N, 8, F]
        if packed is not None:
            # The rounded values, with the gradient passed straight through to the table.
            rounded = packed[entries, None].view(torch.bfloat16).to(table.dtype)
            values = values + (rounded - values).detach()
        found.append((weights.to(table.dtype)[..., None] * values).sum(dim=1))
    features = torch.cat(found, dim=-1)
    return features if packed is None else features.to(torch.bfloat16)


def corners(positions: Tensor, grid: HashGrid, level: int) -> TwoTensors:
    """Table entries [N, 8] of the corners around `positions` in [0, 1]^3, and their weights."""
    scaled = positions * grid.scales[level] + 0.5  # [N, 3]
    cell = scaled.detach().floor()
    fraction = (scaled - cell)[:, None]  # [N, 1, 3]
    corner = torch.arange(8, device=positions.device)
    bits = corner[:, None] >> torch.arange(3, device=positions.device) & 1  # [8, 3]
    weights = torch.where(bits.bool(), fraction, 1 - fraction).prod(dim=-1)
    x, y, z = (cell.long()[:, None] + bits).unbind(dim=-1)  # vertices
    if res := grid.strides[level]:
        entry = x + y * res + z * res**2
    else:
        entry = x * PRIMES[0] ^ (y * PRIMES[1] & 0xFFFFFFFF) ^ (z * PRIMES[2] & 0xFFFFFFFF)
    return grid.offsets[level] + entry % grid.sizes[level], weights
