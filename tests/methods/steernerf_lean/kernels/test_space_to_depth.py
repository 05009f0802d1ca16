"""Rows and pixels of cells: gradients by finite differences, wrong inputs.

Its values are compared with a dense network in `test_lean_renderer.py`.
"""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor

from methods.steernerf_lean.kernels.space_to_depth import (
    CellInputs,
    Layout,
    depth_to_space,
    space_to_depth,
)

LAYOUT = Layout(channels=4, frames=1, scale=2, history=True, surface=True)
CELLS = torch.tensor([0, 1, 5, 4])
"""Of 2 x 3; two at the border, so that samples beyond it count more than once."""

POINTS, SURFACE = 3, 5


def numbers(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def entries(*shape: int, below: int) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randint(-1, below, shape, generator=generator, dtype=torch.int32)


def rows_of(values: Tensor, alpha: Tensor, points: Tensor, surface: Tensor, **options):
    dtype = values.dtype
    history = numbers(4, 4, 3, dtype=dtype), entries(4, 4, below=1).to(dtype) + 1
    inputs = CellInputs(
        values,
        alpha,
        numbers(4, seed=2, dtype=dtype),
        CELLS,
        [(points, entries(4, 6, below=POINTS))],
        history,
        (surface, entries(4, 4, below=SURFACE)),
    )
    return space_to_depth(inputs, LAYOUT, **options)


def inputs(dtype: torch.dtype = torch.float64) -> list[Tensor]:
    shapes = ((2, 3, 4), (2, 3), (POINTS, 4), (SURFACE, 5))
    return [numbers(*shape, seed=i, dtype=dtype) for i, shape in enumerate(shapes)]


def test_gradients_of_rows_are_finite_differences() -> None:
    learned = [x.requires_grad_() for x in inputs()]
    assert torch.autograd.gradcheck(partial(rows_of, backend="reference"), learned)


def test_gradients_of_pixels_are_finite_differences() -> None:
    parts = [numbers(4, 4, 3), numbers(6, LAYOUT.width), numbers(6, 16), numbers(6, 15)]
    learned = [x.requires_grad_() for x in parts]
    assert torch.autograd.gradcheck(
        lambda *x: depth_to_space(*x, layout=LAYOUT, backend="reference"), learned
    )


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize("wrong", [-2, POINTS, SURFACE])
def test_an_index_that_names_no_point_is_refused(backend: str, wrong: int) -> None:
    values, alpha, points, surface = inputs(torch.float32)
    index, at_surface = entries(4, 6, below=POINTS), entries(4, 4, below=SURFACE)
    if wrong < SURFACE:
        index[0, 0] = wrong
    else:
        at_surface[2, 1] = wrong
    seen = (values, alpha, numbers(4, dtype=torch.float32), CELLS)
    given = CellInputs(*seen, [(points, index)], None, (surface, at_surface))
    with pytest.raises(ValueError, match="index: expected -1 to"):
        space_to_depth(given, LAYOUT, backend=backend)


def test_columns_that_do_not_fit_the_layout_are_refused() -> None:
    values, alpha, points, surface = inputs()
    with pytest.raises(ValueError, match="surface values"):
        rows_of(values, alpha, points, surface[:, :-1])
    drawn = numbers(4, 4, 3), numbers(4, LAYOUT.width), numbers(4, 16)
    with pytest.raises(ValueError, match="matrix"):
        depth_to_space(*drawn, None, LAYOUT)
    with pytest.raises(ValueError, match="rows: expected one for each of 4 cells, got 3"):
        depth_to_space(drawn[0], drawn[1][:3], drawn[2][:3], numbers(3, 15), LAYOUT)
