"""Cases of choosing samples: no rays, rays without samples, one to three pieces, some of which most
rays lack; a batch, timed."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import Agreement, Case
from methods.kernels.dispatch import served
from methods.kernels.keep import keep

BATCH = 12_700
"""Rays of the case that is timed, as many as in a step of stage 1."""


def cases() -> list[Case]:
    """Rays, pieces of each, most samples of a piece, and one of how many thin ones is kept."""
    kernel = Agreement("keep", served(__package__), "integers: 0")
    kinds = (
        (0, 1, 3, 4),
        (9, 2, 0, 4),
        (50, 1, 9, 4),
        (50, 3, 5, 4),
        (50, 2, 5, 1),
        (BATCH, 3, 3, 4),
    )
    return [
        kernel.case(
            f"{rays:,} rays of {pieces} pieces, up to {most}, one of {every}",
            partial(_prepare, rays, pieces, most, every),
            0.0,
            items=rays if rays == BATCH else None,
        )
        for rays, pieces, most, every in kinds
    ]


def _prepare(
    rays: int, pieces: int, most: int, every: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    """Pieces lie in memory as in rounds of a march: all first ones, then all second ones."""
    generator = torch.Generator().manual_seed(rays)
    lengths = torch.randint(most + 1, (pieces, rays), generator=generator)
    lacking = torch.rand(pieces, rays, generator=generator) < 0.6
    lacking[:1] = False
    lengths[lacking] = 0
    starts = (lengths.flatten().cumsum(0) - lengths.flatten()).view_as(lengths)
    starts[lacking] = lengths.sum()
    counts = (lengths - torch.randint(2, lengths.shape, generator=generator)).clamp(min=0)
    starts, counts = starts.to(device), counts.to(device)
    turns = torch.randint(2**12, (rays,), generator=generator).int().to(device)
    thin = (torch.rand(int(lengths.sum()), generator=generator) < 0.5).to(device)
    return lambda backend: keep(starts, counts, turns, thin, every, backend=backend)
