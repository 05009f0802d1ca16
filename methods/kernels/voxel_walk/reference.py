"""The voxel walk in plain torch: sorts the planes that a ray crosses, finds the cell behind each.

For small grids, since a ray takes memory for 3 G planes.
"""

from __future__ import annotations

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.march import PARALLEL
from methods.kernels.voxel_walk import BRICK, Crossings, Voxels

BLOCK = 1 << 11
"""Rays that are processed at a time."""


def walk(rays: Rays, voxels: Voxels, start: Tensor, limit: int) -> Crossings:
    count = len(start)
    parts = [
        _walk_block(Rays(rays.origins[block], rays.directions[block]), voxels, start[block], limit)
        for block in (slice(at, at + BLOCK) for at in range(0, max(count, 1), BLOCK))
    ]
    near, far, voxel, counts, resume = (torch.cat(column) for column in zip(*parts, strict=True))
    ray = torch.arange(count, device=start.device)
    ray = ray.repeat_interleave(counts, output_size=len(near))
    offsets = torch.cat((counts.new_zeros(1), counts.cumsum(dim=0)))
    delta = (far - near) * length(rays.directions)[ray]
    middle = (near + far) * 0.5
    longest = int(counts.max()) if count else 0  # read once here, not in each composite
    return Crossings(middle, delta, offsets, near, far, ray.int(), voxel, resume, longest=longest)


def length(directions: Tensor) -> Tensor:
    """Lengths [R] of directions [R, 3]; in float64, so all backends round to the same float32."""
    return directions.double().norm(dim=-1).to(directions.dtype)


def _walk_block(rays: Rays, voxels: Voxels, start: Tensor, limit: int) -> tuple[Tensor, ...]:
    """near, far and voxel [S] of crossings, counts [R], resume [R]."""
    origins, directions = rays.origins, rays.directions
    size, rows = voxels.resolution, len(origins)
    parallel = directions.abs() < PARALLEL
    # Change of t per length along each axis, 0 for a ray that does not move along it: [R, 3].
    slope = torch.where(parallel, 0, 1 / torch.where(parallel, 1, directions))
    width = 1 / origins.new_full((), size)
    edges = torch.arange(size + 1, device=origins.device).to(origins) * width
    planes = (edges - origins[..., None]) * slope[..., None]  # [R, 3, G + 1]

    inside = (origins >= 0) & (origins <= 1)
    outside = torch.where(inside, -torch.inf, torch.inf)
    low, high = planes[..., 0], planes[..., -1]
    enter = torch.where(parallel, outside, torch.minimum(low, high)).amax(dim=1).clamp(min=0)
    leave = torch.where(parallel, -outside, torch.maximum(low, high)).amin(dim=1)
    reach = length(directions)
    alive = origins.isfinite().all(dim=1) & (reach > 0) & reach.isfinite()
    alive &= (enter < leave) & leave.isfinite() & (start < leave)
    near, far = (torch.where(alive, t, 0)[:, None] for t in (torch.maximum(enter, start), leave))

    planes = planes.sort(dim=2).values  # in the order in which the ray meets them
    crossed = torch.where(parallel[..., None] | ~alive[:, None, None], torch.inf, planes)
    t = torch.cat((near, crossed.flatten(1)), dim=1)
    t = torch.minimum(torch.maximum(t, near), far).sort(dim=1).values
    enter, leave = t[:, :-1].contiguous(), t[:, 1:]  # [R, 3 (G + 1)]

    cells = []
    for axis in range(3):
        passed = torch.searchsorted(crossed[:, axis].contiguous(), enter, right=True)
        cell = torch.where(slope[:, axis, None] > 0, passed - 1, size - passed)
        still = (torch.nan_to_num(origins[:, axis]).clamp(0, 1) * size).long()
        cells.append(torch.where(parallel[:, axis, None], still[:, None], cell))
    voxel = _look_up(torch.stack(cells, dim=-1).clamp(0, size - 1), voxels)

    rank = ((voxel >= 0) & (leave > enter)).cumsum(dim=1)
    kept = (voxel >= 0) & (leave > enter) & (rank <= limit)
    counts = kept.sum(dim=1)
    ended = torch.where(kept, leave, -torch.inf).amax(dim=1) if rows else near[:, 0]
    more = (counts == limit) & (ended < far[:, 0])
    resume = torch.where(more, ended, torch.inf)
    place = kept.flatten().nonzero().squeeze(1)  # waits for a GPU once, not three times
    enter, leave, voxel = (x.flatten()[place] for x in (enter, leave, voxel))
    return enter, leave, voxel, counts, resume


def _look_up(cells: Tensor, voxels: Voxels) -> Tensor:
    """The voxels at `cells` [..., 3], -1 where there is none."""
    brick = voxels.bricks[tuple((cells // BRICK).unbind(dim=-1))]
    x, y, z = (cells % BRICK).unbind(dim=-1)
    if not len(voxels):
        return brick
    return torch.where(
        brick >= 0, voxels.leaves[brick.clamp(min=0), (x * BRICK + y) * BRICK + z], -1
    )
