"""Lists of what is left, and how often a GPU is waited for to make them."""

from __future__ import annotations

import torch

from bench.waits import device_waits
from methods.rendering.compaction import indices_where, kept_indices
from tests.pretended_gpu import PretendedGpu

MASK = torch.tensor([False, True, True, False, True])


def test_a_gpu_computes_all_and_waits_for_nothing_a_cpu_what_is_worth_it(gpu: PretendedGpu) -> None:
    assert kept_indices(MASK).tolist() == [1, 2, 4]
    mask = MASK.to("cuda")
    with device_waits() as waits:
        found = kept_indices(mask)
    assert found.tolist() == [0, 1, 2, 3, 4]
    assert not waits


def test_the_places_of_many_masks_are_waited_for_once(gpu: PretendedGpu) -> None:
    masks = [MASK, ~MASK, torch.zeros(3, dtype=torch.bool), torch.zeros(0, dtype=torch.bool)]
    there = [mask.to("cuda") for mask in masks]
    with device_waits() as waits:
        found = indices_where(there)
    assert [place.tolist() for place in found] == [[1, 2, 4], [0, 3], [], []]
    assert waits.total() == 1
    assert indices_where([]) == []
