"""Cells: which are near matter, their pixels, and the way there and back."""

from __future__ import annotations

import torch

from bench.cameras import pixel_grid
from methods.steernerf_lean.cells import cells_near, centres, paint, pixels_of

SCALE = 3
HEIGHT, WIDTH = 4, 5
SOME = torch.tensor([7, 0, 19, 7])


def picture() -> torch.Tensor:
    """[h s, w s, 2], every pixel another one."""
    pixels = torch.arange(HEIGHT * SCALE * WIDTH * SCALE * 2)
    return pixels.view(HEIGHT * SCALE, WIDTH * SCALE, 2)


def test_cells_near_matter_touch_it() -> None:
    seen = torch.zeros(9, 12, dtype=torch.bool)
    seen[0, 1] = seen[6, 11] = True
    want = [
        row * 12 + column
        for row in range(9)
        for column in range(12)
        if any(max(abs(row - r), abs(column - c)) <= 1 for r, c in ((0, 1), (6, 11)))
    ]
    assert cells_near(seen).flatten().nonzero().flatten().tolist() == want
    assert not cells_near(torch.zeros_like(seen)).any()


def test_pixels_of_a_cell_are_those_at_their_centres() -> None:
    image, at = picture(), centres(SOME, WIDTH, SCALE)
    assert at.shape == (4, SCALE**2, 2)
    column, row = (at - 0.5).long().unbind(dim=-1)
    assert torch.equal(pixels_of(image, SOME, SCALE), image[row, column])
    # Of all cells, every pixel once.
    every = centres(torch.arange(HEIGHT * WIDTH), WIDTH, SCALE).flatten(0, 1)
    rows = {tuple(centre) for centre in every.tolist()}
    assert rows == {tuple(centre) for centre in pixel_grid(WIDTH * SCALE, HEIGHT * SCALE).tolist()}


def test_pictures_are_painted_cell_by_cell() -> None:
    size, background = torch.Size((HEIGHT, WIDTH)), torch.tensor([-1, -2])
    cells = [torch.tensor([3, 8]), torch.tensor([], dtype=torch.long), torch.tensor([19])]
    pixels = picture().flatten(0, 1)[: 3 * SCALE**2].view(3, SCALE**2, 2)
    painted = paint(cells, size, SCALE, pixels, background)
    assert painted.shape == (3, HEIGHT * SCALE, WIDTH * SCALE, 2)
    assert torch.equal(pixels_of(painted[0], cells[0], SCALE), pixels[:2])
    assert torch.equal(pixels_of(painted[2], cells[2], SCALE), pixels[2:])
    is_background = (painted == background).all(dim=-1)
    assert is_background.sum(dim=(1, 2)).tolist() == [180 - 18, 180, 180 - 9]
