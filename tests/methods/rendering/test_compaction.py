"""Lists of what is left, and how often a GPU is waited for to make them."""

import torch

from bench.waits import device_waits
from methods.rendering.compaction import indices_where

MASK = torch.tensor([False, True, True, False, True])


def test_the_places_of_many_masks_are_waited_for_once(gpu):
    masks = [MASK, ~MASK, torch.zeros(3, dtype=torch.bool), torch.zeros(0, dtype=torch.bool)]
    there = [mask.to("cuda") for mask in masks]
    with device_waits() as waits:
        found = indices_where(there)
    assert [place.tolist() for place in found] == [[1, 2, 4], [0, 3], [], []]
    assert waits.total() == 1
    assert indices_where([]) == []
