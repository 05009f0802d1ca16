"""Whether work is left out by lists of what is left: on a CPU, where they cost nothing to make.

On a GPU the host would wait for the length of such a list until all work before is done. There what
is not needed is computed with the rest, in a way that changes nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def compacts(device: torch.device) -> bool:
    """Whether lists are made of what is left."""
    return device.type == "cpu"


def kept_indices(mask: Tensor) -> Tensor:
    """Where `mask` [N] is true, in order; all N places where no lists are made."""
    if compacts(mask.device):
        return mask.nonzero().squeeze(1)
    return torch.arange(len(mask), device=mask.device)


def to_host(numbers: Sequence[Tensor]) -> list[int]:
    """All integers in `numbers`, of any shapes. The host waits for a GPU once, not for each."""
    return torch.cat([number.flatten() for number in numbers]).tolist()


def indices_where(masks: Sequence[Tensor], sizes: Sequence[int] | None = None) -> list[Tensor]:
    """Where each of `masks` is true, in order.

    Args:
        sizes: how often each is true; None: a GPU is waited for, once for all.
    """
    if not masks:
        return []
    if sizes is None:
        sizes = to_host([mask.sum() for mask in masks])
    return [
        torch.nonzero_static(mask, size=size).squeeze(1)
        for mask, size in zip(masks, sizes, strict=True)
    ]
