"""Hash-grid encoding in plain torch: any dtype, any device, differentiable in table and positions."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.kernels.encode import PRIMES, HashGrid


def encode(
    positions: Tensor,
    table: Tensor,
    grid: HashGrid,
    *,
    packed: Tensor | None = None,
    grad_buffer: Tensor | None = None,
) -> Tensor:
    """See `methods.kernels.encode.encode`."""
    if grad_buffer is not None:
        table = table.detach().requires_grad_()
        table.register_hook(grad_buffer.add_)
    source = table if packed is None else _unpack(packed, table)
    inside = torch.where(positions > 0, positions, 0).clamp(max=1)
    levels = [_encode_level(inside, source, grid, level) for level in range(grid.levels)]
    features = torch.cat(levels, dim=-1)
    return features if packed is None else features.to(torch.bfloat16)


def _unpack(packed: Tensor, table: Tensor) -> Tensor:
    """The rounded entries as values, with the gradient passed straight through to `table`."""
    rounded = packed[:, None].view(torch.bfloat16).to(table.dtype)
    return table + (rounded - table).detach()


def _encode_level(positions: Tensor, table: Tensor, grid: HashGrid, level: int) -> Tensor:
    scaled = positions * grid.scales[level] + 0.5  # [N, 3]
    cell = scaled.detach().floor()
    fraction = scaled - cell
    features = torch.zeros(len(positions), grid.features, dtype=table.dtype, device=table.device)
    for corner in range(8):
        bits = torch.tensor([corner >> axis & 1 for axis in range(3)], device=positions.device)
        index = grid.offsets[level] + _entry(cell.long() + bits, grid, level)
        weight = torch.where(bits.bool(), fraction, 1 - fraction).prod(dim=-1, keepdim=True)
        features = features + weight.to(table.dtype) * table[index]
    return features


def _entry(vertex: Tensor, grid: HashGrid, level: int) -> Tensor:
    """Table entry, within its level, of integer grid vertices [N, 3]."""
    x, y, z = vertex.unbind(dim=-1)
    if grid.dense[level]:
        res = grid.resolutions[level]
        return (x + y * res + z * res**2) % grid.sizes[level]
    hashed = x * PRIMES[0] ^ (y * PRIMES[1] & 0xFFFFFFFF) ^ (z * PRIMES[2] & 0xFFFFFFFF)
    return hashed % grid.sizes[level]
