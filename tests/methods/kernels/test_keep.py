"""Which samples of rays are kept."""

from __future__ import annotations

import pytest
import torch

from methods.kernels.keep import keep


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_of_the_thin_samples_of_a_ray_every_second_is_kept_through_its_pieces(backend: str) -> None:
    """Ray 0 has samples 0, 1, 2 and 5, 6, of which 7 is hidden; ray 1 has 3 and 4; ray 2 none."""
    starts = torch.tensor([[0, 3, 5], [5, 8, 8]])
    counts = torch.tensor([[3, 2, 0], [2, 0, 0]])
    turns = torch.tensor([0, 1, 0], dtype=torch.int32)
    thin = torch.tensor([1, 1, 0, 1, 1, 1, 1, 0], dtype=torch.bool)
    index, kept = keep(starts, counts, turns, thin, 2, backend=backend)
    # Of ray 0 numbers 0 (thin, even), 2 (thick), 4 (thin, even); of ray 1 number 2.
    assert index.tolist() == [0, 2, 6, 4]
    assert kept.tolist() == [3, 1, 0]


def test_wrong_arguments_are_named() -> None:
    starts, turns = torch.zeros(1, 2, dtype=torch.int64), torch.zeros(2, dtype=torch.int32)
    thin = torch.zeros(3, dtype=torch.bool)
    with pytest.raises(ValueError, match="counts: expected shape"):
        keep(starts, starts[:, :1], turns, thin, 4)
    with pytest.raises(ValueError, match="turns: expected shape"):
        keep(starts, starts, turns[:1], thin, 4)
    with pytest.raises(ValueError, match="every: expected 1 or more, got 0"):
        keep(starts, starts, turns, thin, 0)
