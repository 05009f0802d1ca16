"""The splatting against a plain loop over the points, closed forms and finite differences."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from bench.cameras import pixel_grid
from methods.steernerf.kernels.splat import gather, splat

BACKENDS = ["reference", "cpu"]


def scatter_points(
    count: int, width: int, height: int, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """Points inside and around the picture; many share a depth, some a u or a v, some are equal."""
    generator = torch.Generator().manual_seed(count)
    size = torch.tensor([width, height])
    pixels = (torch.rand(count, 2, generator=generator) * 1.5 - 0.25) * size
    depth = (4 * torch.rand(count, generator=generator)).round() - 1
    return ((4 * pixels).round() / 4).to(dtype), depth.to(dtype)


def plain_splat(pixels: Tensor, depth: Tensor, width: int, height: int) -> list[list[int]]:
    """The definition, a point at a time, in Python numbers."""
    shown: dict[tuple[int, int], int] = {}
    for i, ((u, v), z) in enumerate(zip(pixels.tolist(), depth.tolist(), strict=True)):
        if math.isfinite(u) and math.isfinite(v) and math.isfinite(z) and z > 0:
            shown[math.floor(v), math.floor(u)] = i
    return [[shown.get((row, column), -1) for column in range(width)] for row in range(height)]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(
    ("width", "height"), [(1, 1), (13, 7), (60, 80), (4097, 3)], ids=lambda size: str(size)
)
def test_a_picture_is_the_definition(width: int, height: int, backend: str) -> None:
    pixels, depth = scatter_points(2000, width, height)
    index = splat(pixels, depth, width, height, backend=backend)
    assert index.dtype == torch.int32
    assert index.tolist() == plain_splat(pixels, depth, width, height)
    assert (index >= 0).any()


def test_the_reference_keeps_the_digits_of_float64() -> None:
    pixels, depth = scatter_points(500, 9, 9, torch.float64)
    pixels -= 1e-12  # nothing in float32: over the border of a pixel
    index = splat(pixels, depth, 9, 9, backend="reference")
    assert index.tolist() == plain_splat(pixels, depth, 9, 9)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_last_of_several_points_is_shown_whatever_its_depth(backend: str) -> None:
    pixels, depth = torch.tensor([[0.5, 0.5], [0.1, 0.1], [0.9, 0.2]]), torch.tensor([2.0, 3.0, -1])
    assert splat(pixels, depth, 1, 1, backend=backend).item() == 1
    assert splat(pixels[:2].flip(0), depth[:2].flip(0), 1, 1, backend=backend).item() == 1


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("depth", [0.0, -0.0, -1.0, -1e20, math.inf, -math.inf, math.nan])
def test_a_depth_that_is_not_finite_and_positive_is_not_shown(depth: float, backend: str) -> None:
    table = torch.tensor([[0.5, 0.5, 1e10], [0.5, 0.5, depth]])
    index = splat(table[:, :2], table[:, 2], 1, 1, backend=backend)
    assert index.item() == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("depth", [1e-20, 1e-42, 1e20, 3e38])
def test_any_finite_positive_depth_is_shown(depth: float, backend: str) -> None:
    index = splat(torch.tensor([[0.5, 0.5]]), torch.tensor([depth]), 1, 1, backend=backend)
    assert index.item() == 0


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e20, -1e20, 2.0**32, -(2.0**31)])
def test_a_point_that_lands_nowhere_is_not_shown(value: float, axis: int, backend: str) -> None:
    pixels = torch.full((1, 2), 0.5)
    pixels[0, axis] = value
    assert (splat(pixels, torch.ones(1), 5, 4, backend=backend) == -1).all()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(
    ("value", "cell"),
    [
        (-0.4, None),
        (-1e-20, None),
        (-0.0, 0),
        (0.0, 0),
        (1e-20, 0),
        (0.999, 0),
        (1.0, 1),
        (6.999, 6),
        (7.0, None),
        (7.4, None),
    ],
)
def test_the_border_of_a_pixel_belongs_to_the_next_and_that_of_the_picture_to_none(
    value: float, cell: int | None, axis: int, backend: str
) -> None:
    pixels = torch.full((1, 2), 3.5)
    pixels[0, axis] = value
    landed = (splat(pixels, torch.ones(1), 7, 7, backend=backend) == 0).nonzero()
    place = [3, 3]  # row, column
    if cell is not None:
        place[1 - axis] = cell
    assert landed.tolist() == ([] if cell is None else [place])


@pytest.mark.parametrize("backend", BACKENDS)
def test_without_points_nothing_is_shown(backend: str) -> None:
    index = splat(torch.zeros(0, 2), torch.zeros(0), 3, 2, backend=backend)
    assert index.tolist() == [[-1, -1, -1], [-1, -1, -1]]
    assert gather(torch.zeros(0, 4), index, backend=backend).tolist() == [[[0.0] * 4] * 3] * 2


@pytest.mark.parametrize("backend", BACKENDS)
def test_pixel_centres_land_in_their_own_pixel(backend: str) -> None:
    index = splat(pixel_grid(31, 17), torch.ones(31 * 17), 31, 17, backend=backend)
    assert index.flatten().tolist() == list(range(31 * 17))


@pytest.mark.parametrize("backend", BACKENDS)
def test_strided_points_are_read_as_they_stand(backend: str) -> None:
    pixels, depth = scatter_points(400, 9, 9)
    table = torch.cat((depth[:, None], pixels), dim=1)  # a row of three, used in two parts
    want = splat(pixels, depth, 9, 9, backend=backend)
    assert torch.equal(splat(table[:, 1:], table[:, 0], 9, 9, backend=backend), want)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_pixel_gathers_the_row_of_its_point_or_zeros(backend: str) -> None:
    values = torch.rand(40, 3, generator=torch.Generator().manual_seed(0))
    values[0] = values[-1] = torch.nan  # where nothing is shown, no row may be read
    index = torch.randint(-1, 40, (2, 5, 7), generator=torch.Generator().manual_seed(1)).int()
    got = gather(values, index, backend=backend)
    assert got.shape == (2, 5, 7, 3)
    for place, point in enumerate(index.flatten().tolist()):
        want = torch.zeros(3) if point < 0 else values[point]
        assert torch.equal(got.view(-1, 3)[place].nan_to_num(2.0), want.nan_to_num(2.0))


@pytest.mark.parametrize("backend", BACKENDS)
def test_strided_indices_are_read_as_they_stand(backend: str) -> None:
    values = torch.rand(20, 3)
    index = torch.arange(-1, 19, dtype=torch.int32).view(4, 5).T
    want = gather(values, index.contiguous(), backend=backend)
    assert torch.equal(gather(values.T.contiguous().T, index, backend=backend), want)


def test_gradients_in_float64() -> None:
    values = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    index = torch.tensor([[0, -1, 2], [2, 2, 3]], dtype=torch.int32)
    assert torch.autograd.gradcheck(lambda v: gather(v, index, backend="reference"), values)


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_gradient_of_a_point_is_summed_over_the_pixels_that_show_it(backend: str) -> None:
    values = torch.zeros(4, 2, requires_grad=True)
    index = torch.tensor([[3, -1, 0], [3, 3, -1]], dtype=torch.int32)
    weight = torch.tensor([[[1.0, -1], [2, -2], [4, -4]], [[8, -8], [16, -16], [32, -32]]])
    (gather(values, index, backend=backend) * weight).sum().backward()
    assert values.grad is not None
    assert values.grad.tolist() == [[4.0, -4.0], [0.0, 0.0], [0.0, 0.0], [25.0, -25.0]]


def test_the_backward_pass_gives_the_same_bits_twice() -> None:
    values = torch.rand(50, 6, generator=torch.Generator().manual_seed(0)).requires_grad_()
    index = torch.randint(-1, 50, (300, 300), generator=torch.Generator().manual_seed(1)).int()
    grads = [
        torch.autograd.grad(gather(values, index, backend="cpu").square().sum(), values)[0]
        for _ in range(2)
    ]
    assert torch.equal(*grads)


def test_the_number_of_threads_does_not_change_the_picture() -> None:
    pixels, depth = scatter_points(5000, 50, 3)  # three rows: a thread may be left without any
    before, pictures = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 4):
            torch.set_num_threads(threads)
            pictures.append(splat(pixels, depth, 50, 3, backend="cpu"))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(pictures[0], pictures[1])
    assert torch.equal(pictures[0], pictures[2])


def test_points_need_no_gradient() -> None:
    pixels, depth = scatter_points(100, 9, 9)
    want = splat(pixels, depth, 9, 9)
    pixels.requires_grad_()
    for backend in BACKENDS:
        assert torch.equal(splat(pixels, depth, 9, 9, backend=backend), want)


def test_wrong_arguments_are_named() -> None:
    pixels, depth = torch.zeros(3, 2), torch.ones(3)
    values, index = torch.zeros(3, 2), torch.zeros(4, dtype=torch.int32)
    with pytest.raises(ValueError, match=r"pixels: expected shape \[any, 2\], got \[3\]"):
        splat(depth, depth, 5, 4)
    with pytest.raises(ValueError, match=r"depth: expected shape \[3\], got \[2\]"):
        splat(pixels, depth[:2], 5, 4)
    with pytest.raises(ValueError, match="width, height: expected 1 or more, got 5 x 0"):
        splat(pixels, depth, 5, 0)
    with pytest.raises(ValueError, match="splats float32"):
        splat(pixels.double(), depth, 5, 4, backend="cpu")
    with pytest.raises(ValueError, match="values: expected shape"):
        gather(depth, index)
    with pytest.raises(ValueError, match=r"index: expected int32, got torch\.int64"):
        gather(values, index.long())
    for wrong in (-2, 3):
        with pytest.raises(ValueError, match="index: expected -1 to 2 for 3 rows of values"):
            gather(values, index + wrong)
    with pytest.raises(ValueError, match="splats float32, got values"):
        gather(values.double(), index, backend="cpu")
