"""Which pixels are drawn where the error is."""

from __future__ import annotations

import pytest
import torch

from methods.instant_ngp.error_map import RUN, UNSEEN, ErrorMap

CPU = torch.device("cpu")


def test_runs_are_drawn_in_proportion_to_the_root_of_their_error() -> None:
    chances = ErrorMap(3 * RUN, CPU)
    chances.errors.copy_(torch.tensor([0.04, 0.0, 0.36]))
    chances.refresh()
    drawn = chances.draw(400, torch.Generator().manual_seed(0)) // RUN
    assert torch.equal(drawn, drawn.sort().values)
    # One from each of 400 equal parts, of which the first 100 belong to the first run.
    assert torch.bincount(drawn, minlength=3).tolist() == pytest.approx([100, 0, 300], abs=1)


def test_all_pixels_of_a_run_can_be_drawn_and_none_beyond_the_last() -> None:
    pixels = RUN + 3
    chances = ErrorMap(pixels, CPU)
    drawn = chances.draw(100 * RUN, torch.Generator().manual_seed(0))
    assert torch.equal(drawn.unique(), torch.arange(pixels))


def test_a_new_error_counts_as_much_as_the_estimate() -> None:
    chances = ErrorMap(2 * RUN, CPU)
    chances.learn(torch.tensor([0, RUN - 1]), torch.tensor([0.5, 0.3]))
    first = (UNSEEN + 0.5 + 0.3) / 3
    assert chances.errors.tolist() == pytest.approx([first, UNSEEN])
    chances.learn(torch.tensor([1, RUN]), torch.tensor([0.4, 0.0]))
    assert chances.errors.tolist() == pytest.approx([(first + 0.4) / 2, UNSEEN / 2])
