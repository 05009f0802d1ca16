"""The voxel walk in plain torch: sorts the planes that a ray crosses, finds the cell behind each.

For small grids, since a ray takes memory for 3 G planes.
"""

import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.march.reference import crossed, lengths, slopes
from methods.kernels.types import joined, offsets_of, total_and_longest
from methods.kernels.voxel_walk import BRICK, Crossings, Voxels

BLOCK = 1 << 11  # rays that are processed at a time


def walk(rays: Rays, voxels: Voxels) -> Crossings:
    blocks = zip(rays.origins.split(BLOCK), rays.directions.split(BLOCK), strict=True)
    parts = [_walk_block(*block, voxels) for block in blocks]
    near, far, voxel, counts = joined(parts)
    ray = torch.arange(len(counts), device=counts.device)
    ray = ray.repeat_interleave(counts, output_size=len(near))
    delta = (far - near) * lengths(rays.directions)[ray]
    middle = (near + far) * 0.5
    offsets = offsets_of(counts)
    _, longest = total_and_longest(counts, offsets)  # read once here, not in each composite
    where = middle, delta, offsets, near, far, ray.int(), voxel
    return Crossings(*where, longest=longest)


def _walk_block(origins: Tensor, directions: Tensor, voxels: Voxels) -> tuple[Tensor, ...]:
    """near, far and voxel [S] of crossings, counts [R]."""
    size, (slope, parallel) = voxels.resolution, slopes(directions)
    width = 1 / origins.new_full((), size)
    edges = torch.arange(size + 1, device=origins.device).to(origins) * width
    planes = (edges - origins[..., None]) * slope[..., None]  # [R, 3, G + 1]

    enter, leave = crossed(origins, parallel, planes[..., 0], planes[..., -1])
    enter, reach = enter.clamp(min=0), lengths(directions)
    alive = origins.isfinite().all(dim=1) & (reach > 0) & reach.isfinite()
    alive &= (enter < leave) & leave.isfinite()
    near, far = (torch.where(alive, t, 0)[:, None] for t in (enter, leave))

    planes = planes.sort(dim=2).values  # in the order in which the ray meets them
    planes = torch.where(parallel[..., None] | ~alive[:, None, None], torch.inf, planes)
    t = torch.cat((near, planes.flatten(1)), dim=1)
    t = torch.minimum(torch.maximum(t, near), far).sort(dim=1).values
    enter, leave = t[:, :-1].contiguous(), t[:, 1:]  # [R, 3 (G + 1)]

    cells = []
    for axis in range(3):
        passed = torch.searchsorted(planes[:, axis].contiguous(), enter, right=True)
        cell = torch.where(slope[:, axis, None] > 0, passed - 1, size - passed)
        still = (torch.nan_to_num(origins[:, axis]).clamp(0, 1) * size).long()
        cells.append(torch.where(parallel[:, axis, None], still[:, None], cell))
    cell = torch.stack(cells, dim=-1).clamp(0, size - 1)
    voxel = voxels.bricks[tuple((cell // BRICK).unbind(dim=-1))]
    if len(voxels):
        x, y, z = (cell % BRICK).unbind(dim=-1)
        of_brick = voxels.leaves[voxel.clamp(min=0), (x * BRICK + y) * BRICK + z]
        voxel = torch.where(voxel >= 0, of_brick, -1)

    kept = (voxel >= 0) & (leave > enter)
    place = kept.flatten().nonzero().squeeze(1)  # waits for a GPU once, not three times
    enter, leave, voxel = (x.flatten()[place] for x in (enter, leave, voxel))
    return enter, leave, voxel, kept.sum(dim=1)
