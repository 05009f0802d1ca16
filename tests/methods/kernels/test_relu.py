"""The ReLU by bits, against what it is for."""

from __future__ import annotations

import pytest
import torch

from methods.kernels import BACKENDS, availability
from methods.kernels.relu import relu_

USABLE = [name for name in BACKENDS if not availability()[name]]


@pytest.mark.parametrize("backend", USABLE)
@pytest.mark.parametrize("sign", [1, -1])
def test_nan_stays_whatever_its_sign(backend: str, sign: int) -> None:
    x = torch.tensor([sign * torch.nan, -torch.inf, -0.0, torch.inf], dtype=torch.bfloat16)
    got = relu_(x, backend=backend)
    assert got[0].isnan()
    assert got[1:].tolist() == [0, 0, torch.inf]


@pytest.mark.parametrize("backend", USABLE)
def test_it_changes_its_input_and_the_gradient_stops_at_zeros(backend: str) -> None:
    x = torch.tensor([-2.0, 3.0], dtype=torch.bfloat16, requires_grad=True)
    given = 1 * x
    got = relu_(given, backend=backend)
    assert given.tolist() == [0, 3]
    got.sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [0, 1]
