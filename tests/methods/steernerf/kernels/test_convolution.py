"""Convolution of pictures against closed forms; bfloat16 is the reference's."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from bench.case import uniform
from methods.steernerf.kernels.convolution import convolution, halved, reference
from methods.steernerf.kernels.spans import Spans

BACKENDS = ("reference", "cpu")


def pictures(*shape: int, seed: int = 0) -> Tensor:
    return uniform(torch.Generator().manual_seed(seed), shape)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_tap_moves_a_picture_and_zeros_come_in_at_the_border(backend: str) -> None:
    """Of small whole numbers and a weight of 24^2, which no transform rounds."""
    whole = (10 * pictures(1, 1, 6, 9)).round()
    for row, column in torch.cartesian_prod(torch.arange(3), torch.arange(3)).tolist():
        weight = torch.zeros(1, 1, 3, 3)
        weight[0, 0, row, column] = 24**2
        moved = convolution([whole], weight, torch.zeros(1), backend=backend)[0, 0] / 24**2
        padded = torch.nn.functional.pad(whole[0, 0], (1, 1, 1, 1))
        assert torch.equal(moved, padded[row : row + 6, column : column + 9])


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_follows_a_convolution(backend: str) -> None:
    """With weights of 0: bias, sum, ReLU, and four channels on 2 x 2 pixels."""
    nothing, plus = torch.zeros(4, 1, 3, 3), pictures(1, 4, 2, 3)
    bias = torch.tensor([-2.0, 0.5, 1, 3])
    given = [torch.ones(1, 1, 2, 3)], nothing, bias
    every = bias.view(1, 4, 1, 1)
    found = convolution(*given, plus=plus, relu=True, backend=backend)
    assert torch.equal(found, (every + plus).clamp(min=0))
    (enlarged,) = convolution(*given, shuffle=True, backend=backend)[0]
    assert torch.equal(enlarged, bias.view(2, 2).repeat(2, 3))


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixels_outside_the_spans_count_as_0_whatever_they_are(backend: str) -> None:
    """Of 20 x 28 pixels, in bands and units of 8, of which the last are not whole."""
    spans = Spans(torch.tensor([[1, 3], [0, 2], [3, 9]]), 8)
    mask, given = spans.mask(20, 28), pictures(1, 16, 20, 28)
    weight, bias = pictures(16, 16, 3, 3, seed=1), pictures(16, seed=2)
    unknown, zero = (torch.where(mask, given, other) for other in (torch.nan, 0.0))
    wanted = convolution([zero], weight, bias, backend=backend)
    found = convolution([unknown], weight, bias, spans=spans, backend=backend)
    assert torch.equal(found[..., mask], wanted[..., mask])
    smaller, wanted = spans.at(2).mask(10, 14), halved(zero, backend=backend)
    found = halved(unknown, spans=spans, backend=backend)
    assert torch.equal(found[..., smaller], wanted[..., smaller])


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_largest_of_four_pixels_stays_and_nan_is_larger(backend: str) -> None:
    given = torch.tensor([[1.0, 5, -3, -2], [2, 0, -9, torch.nan]]).view(1, 1, 2, 4)
    ((left, right),) = halved(given, backend=backend)[0, 0].tolist()
    assert left == 5
    assert right != right


def test_a_layer_learns_what_it_is_asked_for_alone() -> None:
    """Of two parts, the weight, the bias and a sum; all gradients are compared by the cases."""
    given = [pictures(1, 4, 6, 8), pictures(1, 3, 6, 8, seed=1), pictures(8, 7, 3, 3, seed=2)]
    given += [pictures(8, seed=3), pictures(1, 8, 6, 8)]
    every = [x.clone().requires_grad_() for x in given]

    def drawn(one: Tensor, other: Tensor, weight: Tensor, bias: Tensor, plus: Tensor) -> Tensor:
        return convolution([one, other], weight, bias, plus=plus, relu=True, backend="cpu")

    out = drawn(*every)
    assert torch.equal(out, drawn(*given))
    wanted = torch.autograd.grad(out.square().sum(), every)
    for number, want in enumerate(wanted):
        some = [every[n] if n == number else x for n, x in enumerate(given)]
        (found,) = torch.autograd.grad(drawn(*some).square().sum(), some[number])
        assert torch.equal(found, want)


def test_bfloat16_is_computed_by_the_reference() -> None:
    given = [pictures(1, 16, 8, 8).bfloat16()], pictures(16, 16, 3, 3), pictures(16)
    with torch.autocast("cpu", torch.bfloat16):
        found = convolution(*given, backend="cpu")
        assert found.dtype == torch.bfloat16
        assert torch.equal(found, reference.convolution(*given, None, False, False, None))


def test_float64_asks_for_the_reference() -> None:
    given = [pictures(1, 16, 8, 8).double()], pictures(16, 16, 3, 3).double(), pictures(16).double()
    with pytest.raises(ValueError, match="use backend='reference'"):
        convolution(*given, backend="cpu")
