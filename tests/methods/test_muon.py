"""Muon for convolutions against that of torch for matrices."""

import pytest
import torch
from torch import nn

from methods.training.muon import MOMENTUM, Muon
from tests.common import seeded


@pytest.mark.parametrize("shape", [(4, 3, 3, 3), (48, 2, 3, 3)])
def test_steps_are_those_of_torch_for_matrices(shape):
    """One row for each output channel, whatever its format in memory. Torch iterates in bfloat16,
    with 8 bits, whose errors five iterations multiply by 3.4 each where a singular value is small.
    """
    weight = torch.zeros(shape).to(memory_format=torch.channels_last)
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
