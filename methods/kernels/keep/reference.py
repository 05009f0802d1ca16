"""Choosing samples in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor


def keep(
    starts: Tensor, counts: Tensor, turns: Tensor, thin: Tensor, every: int
) -> tuple[Tensor, Tensor]:
    """See `methods.kernels.keep.keep`."""
    rays = starts.shape[1]
    # The piece that a sample lies in, without a list whose length the host would wait for. Of
    # pieces that start at one place, all but the last are empty.
    begins, order = starts.flatten().sort(stable=True)
    sample = torch.arange(len(thin), device=thin.device)
    piece = order[torch.searchsorted(begins, sample, right=True) - 1]
    number = sample - starts.flatten()[piece]
    before = (counts.cumsum(dim=0) - counts + turns).flatten()
    kept = number < counts.flatten()[piece]
    kept &= ~thin | ((before[piece] + number) % every == 0)
    index = kept.nonzero().squeeze(1)
    ray = piece[index] % max(rays, 1)
    found = counts.new_zeros(rays).index_add_(0, ray, torch.ones_like(index))
    # Samples of a ray lie in memory in their order, piece after piece.
    return index[ray.argsort(stable=True)], found
