"""The depthwise convolution of cells against that of a dense picture, and finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from bench.threads import torch_threads
from methods.steernerf_lean.kernels.depthwise import TAPS, depthwise, neighbours_of

SUM_ERROR = TAPS * TAPS
"""In eps, two roundings: nine products of size 1 at most, each rounded once alone and in at most
eight sums; twice."""


def scattered(batch: int = 1, height: int = 9, width: int = 7) -> Tensor:
    generator = torch.Generator().manual_seed(height)
    return torch.rand(batch, height, width, generator=generator) < 0.5


def draw(*shape: int, seed: int = 0) -> Tensor:
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) - 1


def dense(cells: Tensor, x: Tensor, weight: Tensor) -> Tensor:
    """What torch makes of the pictures in which `x` fills the `cells`, at those cells."""
    picture = x.new_zeros(*cells.shape, x.shape[1])
    picture[cells] = x
    kernel = weight.T.reshape(-1, 1, 3, 3)
    out = functional.conv2d(
        picture.permute(0, 3, 1, 2), kernel, padding=1, groups=len(kernel)
    ).permute(0, 2, 3, 1)
    return out[cells]


CELLS = {
    "scattered": scattered(),
    "three pictures": scattered(3, 5, 6),
    "all": torch.ones(2, 4, 5, dtype=torch.bool),
    "one": torch.ones(1, 1, 1, dtype=torch.bool),
    "none": torch.zeros(2, 4, 5, dtype=torch.bool),
}
KINDS = pytest.mark.parametrize("kind", CELLS)


@KINDS
def test_neighbours_are_the_cells_around_row_by_row(kind: str) -> None:
    cells = CELLS[kind]
    places = [tuple(place) for place in cells.nonzero().tolist()]
    number = {place: i for i, place in enumerate(places)}
    want = [
        [
            number.get((picture, row + down, column + right), -1)
            for down in (-1, 0, 1)
            for right in (-1, 0, 1)
        ]
        for picture, row, column in places
    ]
    got = neighbours_of(cells)
    assert got.dtype == torch.int32
    assert got.shape == (len(places), TAPS)
    assert got.tolist() == want


@KINDS
def test_cells_are_convolved_as_in_a_dense_picture_and_so_are_gradients(kind: str) -> None:
    cells, channels = CELLS[kind], 5
    count = int(cells.sum())
    x = draw(count, channels).double().requires_grad_()
    weight = draw(TAPS, channels, seed=1).double().requires_grad_()
    grad = draw(count, channels, seed=2).double()
    outs = depthwise(x, neighbours_of(cells), weight, backend="reference"), dense(cells, x, weight)
    found = ((out, *torch.autograd.grad(out, (x, weight), grad)) for out in outs)
    for got, want in zip(*found, strict=True):
        torch.testing.assert_close(got, want, rtol=0, atol=1e-12)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_strided_cells_are_read_as_they_stand(backend: str) -> None:
    neighbours = neighbours_of(scattered())
    x, weight = draw(4, len(neighbours)).T, draw(4, TAPS, seed=1).T
    rows = neighbours.T.contiguous().T
    got = depthwise(x, rows, weight, backend=backend)
    want = depthwise(x.contiguous(), neighbours, weight.contiguous(), backend=backend)
    torch.testing.assert_close(got, want, rtol=0, atol=SUM_ERROR * 2.0**-23)


def test_the_backward_pass_gives_the_same_bits_whatever_the_number_of_threads() -> None:
    neighbours = neighbours_of(scattered(1, 60, 50))
    x = draw(len(neighbours), 6).requires_grad_()
    weight = draw(TAPS, 6, seed=1).requires_grad_()
    gradients = []
    for threads in (1, 2, 4):
        with torch_threads(threads):
            out = depthwise(x, neighbours, weight, backend="cpu")
            gradients.append(torch.autograd.grad(out.square().sum(), (x, weight)))
    for others in gradients[1:]:
        assert all(torch.equal(a, b) for a, b in zip(gradients[0], others, strict=True))


def test_wrong_arguments_are_named() -> None:
    neighbours = neighbours_of(torch.ones(1, 2, 2, dtype=torch.bool))
    x, weight = torch.zeros(4, 3), torch.zeros(TAPS, 3)
    with pytest.raises(ValueError, match=r"cells: expected shape \[any, any, any\], got \[2, 2\]"):
        neighbours_of(torch.ones(2, 2, dtype=torch.bool))
    with pytest.raises(ValueError, match=r"x: expected shape \[any, any\], got \[12\]"):
        depthwise(x.flatten(), neighbours, weight)
    with pytest.raises(ValueError, match=r"neighbours: expected shape \[4, 9\], got \[3, 9\]"):
        depthwise(x, neighbours[:3], weight)
    with pytest.raises(ValueError, match=r"weight: expected shape \[9, 3\], got \[3, 9\]"):
        depthwise(x, neighbours, weight.T)
    for one, other in ((x.double(), weight), (x, weight.double())):
        with pytest.raises(ValueError, match="computes with float32"):
            depthwise(one, neighbours, other, backend="cpu")
