"""Muon for convolutions, against its definition by singular vectors, and torch's for matrices."""

import pytest
import torch
from torch import nn

from methods.training.muon import MOMENTUM, Muon
from tests.common import seeded

SHAPES = [(4, 3, 3, 3), (48, 2, 3, 3)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_first_step_is_the_gradient_with_all_singular_values_set_to_one(shape):
    """One row for each output channel. The published iteration ends between 0.68 and 1.21."""
    generator = seeded(0)
    weight, gradient = (
        torch.randn(shape, generator=generator).to(memory_format=torch.channels_last)
        for _ in range(2)
    )
    before = weight.clone()
    weight.grad = gradient.clone()
    Muon([weight], lr=0.1).step()

    rows = torch.stack([(before - weight).flatten(1), gradient.flatten(1)])
    change, slope = rows / (0.2 * 0.1 * max(rows.shape[1:]) ** 0.5)
    left, _, right = torch.linalg.svd(slope, full_matrices=False)
    values = left.T @ change @ right.T
    assert torch.all((values.diagonal() > 0.67) & (values.diagonal() < 1.22))
    off = values - values.diagonal().diag()
    assert off.abs().max() < 1e-3  # 15 products of float32


@pytest.mark.parametrize("shape", SHAPES)
def test_steps_are_those_of_torch_for_matrices(shape):
    """Momentum and scale; torch iterates in bfloat16, with 8 bits, whose errors five iterations
    multiply by 3.4 each where a singular value is small."""
    weight = torch.zeros(shape)
    matrix = nn.Parameter(torch.zeros_like(weight).flatten(1))
    given = {"weight_decay": 0.0, "momentum": MOMENTUM, "adjust_lr_fn": "match_rms_adamw"}
    both = Muon([weight], 0.1), torch.optim.Muon([matrix], 0.1, **given)
    for seed in range(3):
        weight.grad = torch.randn(shape, generator=seeded(seed))
        matrix.grad = weight.grad.flatten(1)
        for optimiser in both:
            optimiser.step()
    lost = torch.linalg.norm(weight.flatten(1) - matrix) / torch.linalg.norm(matrix)
    assert lost < 0.03
