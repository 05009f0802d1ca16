"""Ray marching in plain torch: test every step of every ray, keep those in occupied cells."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.march import PARALLEL, Occupancy, Samples, Segments

BLOCK = 1 << 12
"""Rays whose steps are tested at once: [BLOCK, 1024, 3] positions are 50 MB."""


def march(segments: Segments, occupancy: Occupancy, step: float, limit: int) -> Samples:
    """See `methods.kernels.march.march`."""
    rays = len(segments.start)
    parts = [
        _march_block(segments.take(slice(first, first + BLOCK)), occupancy, step, limit)
        for first in range(0, max(rays, 1), BLOCK)
    ]
    t, positions, per_ray, resume = (torch.cat(column) for column in zip(*parts, strict=True))
    ray = torch.arange(rays, device=t.device).repeat_interleave(per_ray, output_size=len(t))
    offsets = torch.cat((per_ray.new_zeros(1), per_ray.cumsum(dim=0)))
    return Samples(t, torch.full_like(t, step), offsets, ray.int(), positions, resume)


def _march_block(
    segments: Segments, occupancy: Occupancy, step: float, limit: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """t [S] and positions [S, 3] of the samples, how many a ray has [R], where to resume [R]."""
    origins, directions = segments.rays.origins, segments.rays.directions
    window, start = segments.window, segments.start
    near, far, step_t, alive = clip(segments.rays, step, window[:, 1])
    alive &= start >= 0
    count = torch.where(alive, (far - near) / step_t, 0).ceil().clamp(min=0)
    k = torch.arange(int(count.max()) if len(count) else 0, device=origins.device)
    t = near[:, None] + (k + segments.jitter[:, None]) * step_t[:, None]  # [R, K]
    positions = origins[:, None] + t[..., None] * directions[:, None]  # [R, K, 3]
    candidate = alive[:, None] & (t >= window[:, :1]) & (t < far[:, None]) & (k >= start[:, None])
    candidate &= occupancy.holds(torch.where(candidate[..., None], positions, 0))

    rank = candidate.cumsum(dim=1)
    kept = candidate & (rank <= limit)
    per_ray = kept.sum(dim=1)
    full = (per_ray == limit) & (per_ray > 0)
    last = (kept * (k + 1)).amax(dim=1) if len(k) else per_ray
    place = kept.flatten().nonzero().squeeze(1)
    resume = torch.where(full, last, -1).int()
    return t.flatten()[place], positions.flatten(0, 1)[place], per_ray, resume


def clip(rays: Rays, step: float, farthest: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The t between which rays are inside the cube and nearer than `farthest`, their step in t, and
    whether there is anything to march, each [R]."""
    entry, leave = _cross_unit_cube(rays.origins, rays.directions)
    near, far = entry.clamp(min=0), torch.minimum(leave, farthest)
    # In float64, where every backend rounds to the same float32.
    length = rays.directions.double().norm(dim=-1).to(rays.directions.dtype)
    # A true division: `step / length` would multiply by the reciprocal, an ulp away.
    step_t = torch.full_like(length, step) / length
    return near, far, step_t, (near < far) & far.isfinite() & step_t.isfinite()


def _cross_unit_cube(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays enter and leave [0, 1]^3; enter > leave where they miss it (slab test)."""
    parallel = directions.abs() < PARALLEL
    slope = 1 / torch.where(parallel, 1, directions)
    first, second = -origins * slope, (1 - origins) * slope
    inside = (origins >= 0) & (origins <= 1)
    outside = torch.where(inside, -torch.inf, torch.inf)
    lower = torch.where(parallel, outside, torch.minimum(first, second))
    upper = torch.where(parallel, -outside, torch.maximum(first, second))
    return lower.amax(dim=-1), upper.amin(dim=-1)
