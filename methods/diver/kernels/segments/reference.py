"""Segments in plain torch, made of kernels with references of their own."""

import torch
from torch import Tensor
from torch.nn.functional import linear

from bench.types import Rays
from methods.diver.kernels.segments import Corners, Layers, as_intervals
from methods.kernels.composite import composite, visibility
from methods.kernels.corner_gather import corner_gather, trilinear
from methods.kernels.types import Pixels, joined
from methods.kernels.voxel_walk import Crossings, Voxels, walk

CHUNK_RAYS = 1 << 15
"""Rays rendered together: bounds the memory, as all their segments are evaluated at once."""


@torch.no_grad()
def segment_weights(rays: Rays, crossings: Crossings, voxels: Voxels) -> Tensor:
    ray = crossings.ray.long()
    origins, directions = rays.origins[ray], rays.directions[ray]
    corner = voxels.coordinates[crossings.voxel.long()]
    entry, leave = (
        # Clamped, because rounding may lead out of the voxel.
        ((origins + t[:, None] * directions) * voxels.resolution - corner).clamp(0, 1)
        for t in (crossings.near, crossings.far)
    )
    # A weight is a cubic along the segment, for which Simpson's rule is exact.
    return (trilinear(entry) + 4 * trilinear((entry + leave) / 2) + trilinear(leave)) / 6


@torch.no_grad()
def render_segments(
    rays: Rays, corners: Corners, layers: Layers, towards: Tensor, stop: float, faint: float
) -> tuple[Pixels, Tensor, Tensor]:
    """Evaluates all segments, also those behind the end of a ray, whose weight is 0."""
    if len(towards) > CHUNK_RAYS:
        chunks = (slice(at, at + CHUNK_RAYS) for at in range(0, len(towards), CHUNK_RAYS))
        parts = (
            render_segments(rays.take(some), corners, layers, towards[some], stop, faint)
            for some in chunks
        )
        columns = ((*whole.columns, *counts) for whole, *counts in parts)
        values, depth, alpha, crossed, shaded = joined(columns)
        return Pixels(values, depth, alpha), crossed, shaded
    crossings = walk(rays, corners.voxels, backend="reference")
    ray = crossings.ray.long()
    mean = segment_weights(rays, crossings, corners.voxels)
    read = corners.table, corners.rows, crossings.voxel, mean
    features = corner_gather(*read, backend="reference").to(towards)
    hidden = linear(features.relu(), layers.hidden, layers.hidden_bias).relu()
    density = linear(hidden, layers.density, layers.density_bias).relu().squeeze(1)
    intervals = as_intervals(crossings)
    weight, crossed, _ = visibility(density, intervals, stop=stop, backend="reference")
    shown = (linear(hidden, layers.geometry) + towards[ray]).relu()
    colour = linear(shown, layers.colour, layers.colour_bias).sigmoid()
    seen = weight > faint
    colour = torch.where(seen[:, None], colour, 0)
    pixels = composite(density, colour, intervals, stop=stop, backend="reference")
    shaded = torch.zeros(len(towards), dtype=torch.int32, device=towards.device)
    shaded.index_add_(0, ray, seen.int())
    return pixels, crossed.int(), shaded
