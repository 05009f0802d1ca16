"""Small networks in plain torch, one network after the other, for any dtype and device."""

import torch
from torch import Tensor

from bench.types import TwoTensors


def locate(positions: Tensor, cubes: Tensor, corner: Tensor, side: Tensor) -> TwoTensors:
    scaled = (positions.detach() - corner) / side
    cell = scaled.floor()
    sizes = [cell.new_full((), size) for size in cubes.shape]  # filled: no wait for a GPU
    inside = ((cell >= 0) & (cell < torch.stack(sizes))).all(dim=1)
    x, y, z = torch.where(inside[:, None], cell, 0).long().unbind(dim=1)
    return torch.where(inside, cubes[x, y, z], -1), 2 * (scaled - cell) - 1


def order(networks: Tensor, count: int) -> TwoTensors:
    sorted_, permutation = networks.long().sort(stable=True)
    offsets = torch.searchsorted(sorted_, torch.arange(count + 1, device=networks.device))
    return permutation[int(offsets[0]) :], offsets - offsets[0]


def encode_frequencies(inputs: Tensor, frequencies: int) -> Tensor:
    angles = [inputs * 2**k for k in range(frequencies)]
    return torch.cat((inputs, *(f(angle) for angle in angles for f in (torch.sin, torch.cos))), 1)


def grouped_linear(
    inputs: Tensor, weights: Tensor, biases: Tensor, offsets: Tensor, relu: bool
) -> Tensor:
    parts = inputs.split(offsets.diff().tolist())
    layers = zip(parts, weights, biases, strict=True)
    out = [torch.addmm(bias, part, weight) for part, weight, bias in layers]
    joined = torch.cat(out) if out else inputs.new_zeros(0, weights.shape[2])
    return joined.relu() if relu else joined
