"""Muon for convolutions, against its definition by singular vectors."""

import pytest
import torch

from methods.training.muon import Muon


@pytest.mark.parametrize("shape", [(4, 3, 3, 3), (48, 2, 3, 3)])
def test_the_first_step_is_the_gradient_with_all_singular_values_set_to_one(shape):
    """One row for each output channel. Torch iterates to singular values of 0.5 to 1.5, in
    bfloat16."""
    generator = torch.Generator().manual_seed(0)
    weight, gradient = (
        torch.randn(shape, generator=generator).to(memory_format=torch.channels_last)
        for _ in range(2)
    )
    before = weight.clone()
    optimiser = Muon([weight], lr=0.1)
    weight.grad = gradient.clone()
    optimiser.step()
    optimiser.zero_grad()
    assert weight.grad is None

    rows = torch.stack([(before - weight).flatten(1), gradient.flatten(1)])
    change, slope = rows / (0.2 * 0.1 * max(rows.shape[1:]) ** 0.5)
    left, _, right = torch.linalg.svd(slope, full_matrices=False)
    values = left.T @ change @ right.T
    assert torch.all((values.diagonal() > 0.5) & (values.diagonal() < 1.5))
    off = values - values.diagonal().diag()
    assert off.abs().max() < 0.05


def test_weights_in_another_memory_order_are_refused():
    """Their matrices would be copies, and steps without effect."""
    with pytest.raises(ValueError, match=r"^expected channels-last weights, got strides \(27, 9,"):
        Muon([torch.zeros(4, 3, 3, 3)], lr=0.1)
