"""The field evaluated once per pixel, at the surface that the low-resolution depth gives."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.cameras import cast, unproject
from bench.types import Probe
from methods.rendering.compaction import kept_indices
from methods.rendering.field import CACHED_SAMPLES, Field, query
from methods.rendering.occupancy import STEP
from methods.steernerf.renderer import Points
from methods.steernerf.view import View
from methods.steernerf_lean.cells import centres

LAYER = 4 * STEP
"""Thickness, in scene units, of the layer that a single sample of the surface stands for."""


def surface_points(
    field: Field, depth: Tensor, cells: Tensor, view: View, scale: int, probe: Probe
) -> Points:
    """Sample features and opacity, [P, K + 1], at every pixel of `cells` [N] whose `depth` [N, s^2]
    is finite; differentiable in the field, not in the depth."""
    there = depth.isfinite().flatten()
    known = kept_indices(there)
    probe.count("surface_samples", len(known), view.full.width * view.full.height)
    field.count(probe, len(known), len(known))
    # A row at a time; `x[index]` goes number by number.
    pixels = centres(cells, view.low.width, scale).flatten(0, 1).index_select(0, known)
    near = torch.where(there, depth.flatten(), 0).index_select(0, known)
    points = unproject(view.full, pixels, near)
    # The pixels of a cell share the view direction of its middle.
    middles = cast(view.low, centres(cells, view.low.width, 1)[:, 0])
    encoded = field.encode_directions(middles.directions)
    size = CACHED_SAMPLES if depth.device.type == "cpu" else max(len(points), 1)
    found = []
    for some, cell in zip(points.split(size), (known // scale**2).split(size), strict=True):
        sigma, values = query(field, some, cell, encoded)
        alpha = -torch.expm1(-LAYER * sigma)  # of a layer of that thickness
        found.append(torch.cat((values, alpha[:, None]), dim=1))
    index = torch.full(depth.shape, -1, dtype=torch.int32, device=depth.device)
    number = torch.arange(len(points), dtype=torch.int32, device=depth.device)
    index.view(-1).index_copy_(0, known, torch.where(there.index_select(0, known), number, -1))
    return Points(torch.cat(found), index)
