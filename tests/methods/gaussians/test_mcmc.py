"""Relocation and noise of Gaussians: what stays the same when one becomes many."""

from __future__ import annotations

import math

import pytest
import torch

from methods.gaussians.mcmc import DEAD, disturb, relocate, shared_between
from methods.gaussians.model import Gaussians


def some(opacities: list[float]) -> Gaussians:
    """Gaussians in a row along x, two units apart."""
    count = len(opacities)
    points = torch.zeros(count, 3)
    points[:, 0] = 2 * torch.arange(count)
    gaussians = Gaussians.at(points, torch.rand(count, 3), torch.full((count,), 0.1), 0.5, degree=1)
    with torch.no_grad():
        gaussians.logits.copy_(torch.tensor(opacities).logit())
    return gaussians


def adam(gaussians: Gaussians) -> torch.optim.Adam:
    """After a step in which everything had a gradient of 1, at no rate."""
    optimiser = torch.optim.Adam(gaussians.parameters(), lr=0.0)
    for parameter in gaussians.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimiser.step()
    return optimiser


@pytest.mark.parametrize("copies", [1, 2, 3, 7])
@pytest.mark.parametrize("opacity", [0.05, 0.6, 0.99])
def test_copies_are_together_as_opaque_as_the_one_they_replace(opacity: float, copies: int) -> None:
    new, shrink = shared_between(torch.tensor([opacity]), torch.tensor([copies]))
    assert 1 - (1 - new.item()) ** copies == pytest.approx(opacity, rel=1e-5)
    # Along a line through the centre, by quadrature; sigma is 1 before and `shrink` after.
    x = torch.linspace(-12, 12, 100_001, dtype=torch.float64)
    together = 1 - (1 - new * torch.exp(-((x / shrink) ** 2) / 2)) ** copies
    whole = torch.trapezoid(together, x).item()
    assert whole == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-5)


def test_the_dead_move_to_the_living() -> None:
    gaussians = some([0.9, DEAD / 2, 0.3, DEAD / 5])
    optimiser = adam(gaussians)
    before = gaussians.means.detach().clone()
    assert relocate(gaussians, optimiser, torch.Generator().manual_seed(0)) == 2
    alive = before[[0, 2]]
    for moved in (1, 3):
        assert (gaussians.means[moved] == alive).all(dim=1).any()
    assert torch.equal(gaussians.means[[0, 2]], alive)
    assert (gaussians.opacities > DEAD).all()


def test_what_moved_and_what_it_moved_to_forget_their_moments() -> None:
    gaussians = some([0.9, DEAD / 2, 1e-9])  # nothing else to move to
    optimiser = adam(gaussians)
    gaussians.logits.data[2] = gaussians.logits.data[0]
    assert relocate(gaussians, optimiser, torch.Generator().manual_seed(1)) == 1
    moments = optimiser.state[gaussians.means]["exp_avg"]
    source = 0 if torch.equal(gaussians.means[1], gaussians.means[0]) else 2
    assert (moments[[1, source]] == 0).all()
    assert (moments[2 - source] != 0).all()


@pytest.mark.parametrize("opacities", [[0.5, 0.6], [DEAD / 2, DEAD / 3]], ids=["none", "all"])
def test_nothing_moves_if_none_or_all_are_dead(opacities: list[float]) -> None:
    gaussians = some(opacities)
    before = [parameter.detach().clone() for parameter in gaussians.parameters()]
    assert relocate(gaussians, adam(gaussians), torch.Generator()) == 0
    for parameter, old in zip(gaussians.parameters(), before, strict=True):
        assert torch.equal(parameter, old)


def test_noise_moves_the_faint_along_their_shape_and_leaves_the_opaque() -> None:
    gaussians = some([0.9] + [DEAD / 10] * 999)
    before = gaussians.means.detach().clone()
    with torch.no_grad():
        gaussians.log_scales[:] = torch.tensor([0.1, 0.01, 0.001]).log()
    disturb(gaussians, 1.0, torch.Generator().manual_seed(0))
    moved = (gaussians.means - before).detach()
    assert moved[0].abs().max() < 1e-9
    # The variances of the shape are 0.01, 1e-4 and 1e-6, times a faintness of about 0.61.
    spread = moved[1:].std(dim=0)
    want = torch.sigmoid(torch.tensor(100 * (0.005 - DEAD / 10))) * torch.tensor([1e-2, 1e-4, 1e-6])
    # Of 999 normal numbers the standard deviation is known to 1 / sqrt(2 * 999), 2 %: four times.
    torch.testing.assert_close(spread, want, rtol=0.09, atol=1e-7)
