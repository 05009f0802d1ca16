"""Choosing samples with numba: once to count those of each ray, once to list them."""

from __future__ import annotations

import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import u64

CHUNK = 256  # rays
ONE = u64(1)


def keep(
    starts: Tensor, counts: Tensor, turns: Tensor, thin: Tensor, every: int
) -> tuple[Tensor, Tensor]:
    """See `methods.kernels.keep.keep`."""
    given = [x.contiguous().numpy() for x in (starts, counts, turns, thin)]
    found = torch.empty(len(turns), dtype=torch.int64)
    _count(*given, every, found.numpy())
    ends = found.cumsum(0)
    index = torch.empty(int(ends[-1]) if len(ends) else 0, dtype=torch.int64)
    _list(*given, every, (ends - found).numpy(), index.numpy())
    return index, found


@njit(cache=True, parallel=True)
def _count(starts, counts, turns, thin, every, found):
    pieces, rays = starts.shape
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            turn, total = turns[ray] % every, 0
            for piece in range(pieces):
                first = u64(starts[piece, ray])
                for sample in range(first, first + u64(counts[piece, ray])):
                    total += (turn == 0) | (not thin[sample])
                    turn = 0 if turn + 1 == every else turn + 1
            found[ray] = total


@njit(cache=True, parallel=True)
def _list(starts, counts, turns, thin, every, places, index):
    pieces, rays = starts.shape
    for chunk in prange((rays + CHUNK - 1) // CHUNK):
        for ray in range(chunk * CHUNK, min(rays, (chunk + 1) * CHUNK)):
            turn, place = turns[ray] % every, u64(places[ray])
            for piece in range(pieces):
                first = u64(starts[piece, ray])
                for sample in range(first, first + u64(counts[piece, ray])):
                    if (turn == 0) | (not thin[sample]):
                        index[place] = sample
                        place += ONE
                    turn = 0 if turn + 1 == every else turn + 1
