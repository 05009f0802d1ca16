"""Cases of the hash-grid encoding."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor

from methods.kernels.case import U16, U32, Case, Prepared
from methods.kernels.encode import HashGrid, encode, pack
from methods.kernels.encode.reference import corners

SMALL = HashGrid(levels=4, log2_table=10, n_min=4, n_max=40)
ODD = HashGrid(levels=3, features=3, log2_table=8, n_min=3, n_max=17)
LARGE = HashGrid(log2_table=19, n_max=2048)
VIEW = 1 << 17


def cases() -> list[Case]:
    """Shapes that hurt, and the 131,072 samples of one view that the throughput is stated for."""
    found = []
    for name, count, grid in (
        ("no sample", 0, SMALL),
        ("one sample", 1, SMALL),
        ("257 samples", 257, SMALL),
        ("three features", 1000, ODD),
    ):
        found.append(Case("encode", name, "fp32", count, partial(_forward, count, grid)))
        found.append(Case("encode backward", name, "fp32", count, partial(_backward, count, grid)))
    found.append(Case("encode", "corners", "fp32", 27, partial(_forward, -1, SMALL)))
    found.append(Case("encode", "257 samples", "bf16", 257, partial(_packed, 257, SMALL)))
    coarse = partial(_forward, 257, SMALL, levels=2)
    found.append(Case("encode", "the two coarsest levels", "fp32", 257, coarse))
    learned = partial(_backward, 257, SMALL, packed=True)
    found.append(Case("encode backward", "257 samples", "bf16", 257, learned))
    for name, view in (("view", True), ("random", False)):
        found += [
            Case("encode", name, "fp32", VIEW, partial(_forward, VIEW, LARGE, view=view), True),
            Case("encode", name, "bf16", VIEW, partial(_packed, VIEW, LARGE, view=view), True),
            Case(
                "encode backward",
                name,
                "fp32",
                VIEW,
                partial(_backward, VIEW, LARGE, view=view),
                True,
            ),
        ]
    return found


def _inputs(count: int, grid: HashGrid, view: bool, device: str) -> tuple[Tensor, Tensor]:
    """Positions and a table whose values are at most 1."""
    generator = torch.Generator().manual_seed(count)
    if count == -1:
        edges = torch.tensor([0.0, 0.5, 1.0])
        positions = torch.cartesian_prod(edges, edges, edges)
    elif view:
        positions = _view(count)
    else:
        positions = torch.rand(count, 3, generator=generator)
    table = torch.rand(grid.entries, grid.features, generator=generator) * 2 - 1
    return positions.to(device), table.to(device)


def _view(count: int) -> Tensor:
    """Samples of 64 x 64 neighbouring rays, ray by ray, a step of sqrt(3) / 1024 apart."""
    side, steps = 64, count // 64**2
    pixel = torch.linspace(0.3, 0.5, side)
    v, u = torch.meshgrid(pixel, pixel, indexing="ij")
    t = 0.3 + 3**0.5 / 1024 * torch.arange(steps)
    direction = torch.stack((u - 0.4, v - 0.4, torch.ones_like(u)), dim=-1)
    origin = torch.stack((u, v, torch.zeros_like(u)), dim=-1)
    return (origin[..., None, :] + t[:, None] * direction[..., None, :]).reshape(-1, 3)


def _fraction_error(grid: HashGrid) -> float:
    """Of a trilinear fraction: p = scale x + 1/2 is rounded once or twice, at sizes up to N_max."""
    return 2 * U32 * grid.n_max


def _forward(
    count: int, grid: HashGrid, device: str, view: bool = False, levels: int | None = None
) -> Prepared:
    positions, table = _inputs(count, grid, view, device)
    # Values of at most 1 differ by at most 2 along each of 3 axes; 11 roundings in the blend.
    tolerance = 3 * 2 * _fraction_error(grid) + 11 * U32
    return Prepared(
        lambda backend: (encode(positions, table, grid, levels=levels, backend=backend),), tolerance
    )


def _packed(count: int, grid: HashGrid, device: str, view: bool = False) -> Prepared:
    positions, table = _inputs(count, grid, view, device)
    words = pack(table)
    # As above, then rounded to bfloat16 at a size of at most 1.
    tolerance = 3 * 2 * _fraction_error(grid) + 11 * U32 + U16
    return Prepared(
        lambda backend: (encode(positions, table, grid, packed=words, backend=backend),), tolerance
    )


def _backward(
    count: int, grid: HashGrid, device: str, view: bool = False, packed: bool = False
) -> Prepared:
    positions, table = _inputs(count, grid, view, device)
    table.requires_grad_()
    generator = torch.Generator().manual_seed(1)
    grad = (torch.rand(count, grid.channels, generator=generator) * 2 - 1).to(device)
    words = pack(table) if packed else None
    grad = grad.bfloat16() if packed else grad

    def call(backend: str) -> tuple[Tensor, ...]:
        buffer = torch.zeros_like(table)
        features = encode(positions, table, grid, packed=words, grad_buffer=buffer, backend=backend)
        features.backward(grad)
        return (buffer,)

    # An entry sums |grad| <= 1 over the n samples that touch it. Each weight is off by its three
    # fractions' errors, each partial sum, of size n at most, by u: 2 n roundings, which as
    # independent errors add up to 6 sqrt(n) of them but for one case in 10^8 (Higham, Mary 2019).
    touched = _most_touched(positions, grid) if count else 0
    return Prepared(call, 6 * math.sqrt(touched) * (3 * _fraction_error(grid) + touched * U32))


def _most_touched(positions: Tensor, grid: HashGrid) -> int:
    """How many samples share the entry that is shared most."""
    return max(
        int(corners(positions, grid, level)[0].flatten().bincount().max())
        for level in range(grid.levels)
    )
