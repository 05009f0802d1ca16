"""Finds the part of a data set's space to render, and its place in the unit cube."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.cameras import project
from bench.errors import unexpected
from bench.threads import torch_threads
from bench.types import Camera

MARGIN = 0.05
"""The box of a visual hull is enlarged by this share of its longest side, half at each end."""

CELLS = 64
"""Cells along each side of the cube that is searched for the visual hull."""

BLOCK, GLANCES = 4, 16
"""Before single cells, blocks of BLOCK^3 cells are tested against the first GLANCES pictures: a
dropped block drops all its cells."""


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the data set's units: `lower` and `upper` corner, [3] float64."""

    lower: Tensor
    upper: Tensor

    @property
    def side(self) -> float:
        """The longest side: the length of one scene unit."""
        return (self.upper - self.lower).max().item()

    @property
    def origin(self) -> Tensor:
        """The data set's coordinates of the corner (0, 0, 0) of the unit cube, [3] float64."""
        return (self.lower + self.upper) / 2 - self.side / 2

    def in_unit_cube(self) -> Tensor:
        """[2, 3] float32 corners once the box is centred and its longest side has length 1."""
        corners = torch.stack((self.lower, self.upper))
        return ((corners - self.origin) / self.side).float().clamp(0, 1)

    def grown(self, share: float) -> Box:
        """The box, longer along every axis by `share` of its longest side."""
        return Box(self.lower - share * self.side / 2, self.upper + share * self.side / 2)


def cube(half: float) -> Box:
    """The box [-half, half]^3."""
    return Box(torch.full((3,), -half).double(), torch.full((3,), half).double())


def parse_box(value: object) -> Box:
    """A box from a user's [[x0, y0, z0], [x1, y1, z1]]."""
    expected = "auto, full or a lower and an upper corner [x, y, z]"
    try:
        corners = torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise unexpected("bounds", expected, repr(value)) from error
    if corners.shape != (2, 3) or not corners.isfinite().all() or (corners[1] <= corners[0]).any():
        raise unexpected("bounds", expected, repr(value))
    return Box(corners[0], corners[1])


@torch_threads(1)
def hull_box(cameras: Sequence[Camera], images: Sequence[Tensor], space: Box) -> Box | None:
    """The box of the visual hull of the pictures' masks (alpha > 0) inside `space`.

    A cell is dropped only if its whole projection, plus one pixel around it, lies inside a picture
    and shows nothing. None if the pictures are opaque or no cell is left.
    """
    if any(image.shape[2] < 4 for image in images) or all((x[..., 3] == 255).all() for x in images):
        return None
    size = (space.upper - space.lower) / CELLS
    views = list(zip(cameras, images, strict=True))
    blocks = _left(_grid(CELLS // BLOCK), views[:GLANCES], space.lower, size * BLOCK)
    cells = (blocks[:, None] * BLOCK + _grid(BLOCK)).flatten(0, 1)
    cells = _left(cells, views, space.lower, size)
    if not len(cells):
        return None
    lower = space.lower + size * cells.amin(0)
    upper = space.lower + size * (cells.amax(0) + 1)
    return Box(lower, upper).grown(MARGIN)


def _grid(side: int) -> Tensor:
    """The integer positions [side^3, 3] of a cube of cells."""
    return torch.cartesian_prod(*(torch.arange(side, dtype=torch.float32),) * 3)


def _left(
    cells: Tensor, views: Sequence[tuple[Camera, Tensor]], lower: Tensor, size: Tensor
) -> Tensor:
    """The `cells` [M, 3] of `size` [3], counted from `lower` [3], that no picture drops."""
    for camera, image in views:
        corners = lower + size * (cells[:, None] + _grid(2))  # [M, 8, 3]
        cells = cells[maybe_seen(camera, image[..., 3] > 0, corners.float())]
    return cells


def maybe_seen(camera: Camera, mask: Tensor, corners: Tensor) -> Tensor:
    """[M] bool: whether a cell, given by its `corners` [M, 8, 3], may be seen in `mask` [H, W]."""
    pixels, depth = project(camera, corners.reshape(-1, 3))
    pixels, depth = pixels.reshape(-1, 8, 2), depth.reshape(-1, 8)
    first = pixels.amin(1).floor() - 1
    last = pixels.amax(1).floor() + 2  # one past the last pixel
    limit = first.new_tensor((camera.width, camera.height))
    inside = ((first >= 0) & (last <= limit)).all(1) & (depth > 0).all(1)
    (u0, v0), (u1, v1) = (edge[inside].long().unbind(1) for edge in (first, last))
    # A summed-area table counts the mask's pixels in any rectangle with four look-ups. NumPy's
    # 32-bit cumsum takes a quarter of the time of torch's, which is 64-bit.
    sums = mask.numpy().cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
    table = torch.from_numpy(np.pad(sums, ((1, 0), (1, 0))))
    count = table[v1, u1] - table[v0, u1] - table[v1, u0] + table[v0, u0]
    seen = torch.ones(len(corners), dtype=torch.bool)
    seen[inside] = count > 0
    return seen
