"""The field looked at once a pixel, where the low-resolution depth has the surface."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from bench.cameras import cast, unproject
from bench.types import Probe
from methods.instant_ngp.field import HashField
from methods.rendering.batch import query
from methods.rendering.occupancy import STEP
from methods.steernerf.beyond.cells import centres
from methods.steernerf.renderer import Points
from methods.steernerf.view import View

LAYER = 4 * STEP
"""Thickness, in scene units, of what a single sample of the surface stands for."""

PIECE = 1 << 16
"""Pixels that a CPU looks at together: few enough to stay in the cache, and for who has enough to
stop soon."""


class Surface:
    """Features and opacity of a sample at every pixel of `cells` [N] whose `depth` [N, s^2] is
    finite, a piece at a time: one thread may look at some of them, and later another at the rest.

    Differentiable in the field, not in the depth.
    """

    def __init__(
        self, field: HashField, depth: Tensor, cells: Tensor, view: View, scale: int
    ) -> None:
        self._field, self._shape, device = field, depth.shape, depth.device
        self._known = depth.isfinite().flatten().nonzero().squeeze(1)
        pixels = centres(cells, view.low.width, scale).flatten(0, 1)[self._known]
        self._points = unproject(view.full, pixels, depth.flatten()[self._known])
        # The pixels of a cell share the view direction of its middle.
        self._cell = self._known // scale**2
        middles = cast(view.low, centres(cells, view.low.width, 1)[:, 0])
        self._directions = field.encode_directions(middles.directions)
        size = PIECE if device.type == "cpu" else len(self._points)
        starts = range(0, len(self._points), size) if len(self._points) else (0,)
        self._pieces = [slice(start, start + size) for start in starts]
        self._found: list[Tensor] = []

    def __len__(self) -> int:
        return len(self._points)

    def look(self, probe: Probe, enough: Callable[[], bool] = lambda: False) -> None:
        """Look at one piece after the other, until there are none left or it is `enough`."""
        while len(self._found) < len(self._pieces) and not enough():
            with probe.stage("surface"):
                self._found.append(self._looked_at(self._pieces[len(self._found)], probe))

    def points(self, probe: Probe) -> Points:
        """All of it, opacity the last of [P, K + 1]."""
        self.look(probe)
        with probe.stage("surface"):
            index = torch.full(self._shape, -1, dtype=torch.int32, device=self._points.device)
            number = torch.arange(len(self._points), dtype=torch.int32, device=index.device)
            index.view(-1)[self._known] = number
            return Points(torch.cat(self._found), index)

    def _looked_at(self, piece: slice, probe: Probe) -> Tensor:
        points, cell = self._points[piece], self._cell[piece]
        self._field.count(probe, len(points), len(points))
        sigma, values = query(self._field, points, cell, self._directions)
        alpha = -torch.expm1(-LAYER * sigma)  # of a layer of that thickness
        return torch.cat((values, alpha[:, None]), dim=1)
