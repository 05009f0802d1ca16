"""Compaction of work: on a CPU, only what is needed is computed, from lists of its indices.

On a GPU the host would wait for the length of such a list until all earlier work is done. There
everything is computed, in a way that leaves the result unchanged.
"""

import torch
from torch import Tensor

from bench.types import SomeTensors


def compacts(device: torch.device) -> bool:
    """Whether work on `device` is compacted."""
    return device.type == "cpu"


def to_host(numbers: SomeTensors) -> list[int]:
    """Copy all integers in `numbers`, of any shapes, to the host, which waits for a GPU once."""
    return torch.cat([number.flatten() for number in numbers]).tolist()


def indices_where(masks: SomeTensors) -> list[Tensor]:
    """Indices where each of `masks` is true, in order; the host waits for a GPU, once for all."""
    if not masks:
        return []
    pairs = zip(masks, to_host([mask.sum() for mask in masks]), strict=True)
    return [torch.nonzero_static(mask, size=size).squeeze(1) for mask, size in pairs]
