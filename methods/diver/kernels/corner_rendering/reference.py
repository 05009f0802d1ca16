"""Pixels of corner features, step by step: each step is a kernel with a reference of its own."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import linear

from bench.types import Rays
from methods.diver.kernels.corner_rendering import Corners, Layers
from methods.kernels.composite import composite, visible, weights
from methods.kernels.corner_gather import gather, integral_along
from methods.kernels.types import Intervals, Pixels
from methods.kernels.voxel_walk import Voxels, walk

CHUNK_RAYS = 1 << 15
"""Rays rendered together: bounds the memory, as all their segments are evaluated at once."""


@torch.no_grad()
def by_steps(
    backend: str,
    rays: Rays,
    voxels: Voxels,
    corners: Corners,
    layers: Layers,
    towards: Tensor,
    stop: float,
    faint: float,
) -> tuple[Pixels, Tensor, Tensor]:
    """Render with the `backend` of the kernel of each step.

    It evaluates all segments, also those behind the end of a ray, whose weight is 0.
    """
    count = len(rays.origins)
    chunks = [slice(first, first + CHUNK_RAYS) for first in range(0, max(count, 1), CHUNK_RAYS)]
    parts = [
        _together(backend, rays.take(some), voxels, corners, layers, towards[some], stop, faint)
        for some in chunks
    ]
    *pixels, crossed, shaded = map(torch.cat, zip(*parts, strict=True))
    return Pixels(*pixels), crossed, shaded


def _together(
    backend: str,
    rays: Rays,
    voxels: Voxels,
    corners: Corners,
    layers: Layers,
    towards: Tensor,
    stop: float,
    faint: float,
) -> tuple[Tensor, ...]:
    """Values, depth sums and opacities of `rays`; numbers of segments crossed and shaded."""
    crossings = walk(rays, voxels, backend=backend)
    ray = crossings.ray.long()
    mean = integral_along(rays, crossings, voxels, backend=backend)
    features = gather(corners.table, corners.rows, crossings.voxel, mean, backend=backend)
    hidden = linear(features.to(towards).relu(), layers.hidden, layers.hidden_bias).relu()
    density = linear(hidden, layers.density, layers.density_bias).relu().squeeze(1)
    # Integrated already: every length is 1.
    intervals = Intervals(crossings.t, torch.ones_like(crossings.t), crossings.offsets)
    weight = weights(density, intervals, stop=stop, backend=backend)
    shown = (linear(hidden, layers.geometry) + towards[ray]).relu()
    colour = linear(shown, layers.colour, layers.colour_bias).sigmoid()
    seen = weight > faint
    colour = torch.where(seen[:, None], colour, 0)
    pixels = composite(density, colour, intervals, stop=stop, backend=backend)
    shaded = torch.zeros(len(towards), dtype=torch.int32, device=towards.device)
    shaded.index_add_(0, ray, seen.int())
    crossed, _ = visible(density, intervals, stop=stop, backend=backend)
    return pixels.values, pixels.depth_sum, pixels.alpha, crossed.int(), shaded


render_segments = partial(by_steps, "reference")
"""See `methods.diver.kernels.corner_rendering.render_segments`."""
