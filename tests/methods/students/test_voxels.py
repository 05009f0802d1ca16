"""Sparse voxels: shared corners, eighths that fill a voxel, grids of another resolution."""

import pytest
import torch

from methods.instant_ngp.pixels import PixelBatches
from methods.kernels.corner_gather import OFFSETS
from methods.kernels.types import Occupancy
from methods.kernels.voxel_walk import Voxels
from methods.students.voxels import corners_of, largest_weights, occupied_voxels
from tests.common import seeded


def scattered(share: float, size: int = 16) -> Occupancy:
    return Occupancy(torch.rand(size, size, size, generator=seeded(0)) < share)


def test_corners_are_where_they_belong_and_none_is_there_twice():
    voxels = scattered(0.1).cells.nonzero()
    corners, vertices = corners_of(voxels)
    want = voxels[:, None] + OFFSETS
    assert torch.equal(vertices[corners.long()].long(), want)
    assert torch.equal(vertices, vertices.unique(dim=0))
    assert len(vertices) == len(corners.unique())
    assert corners.dtype == torch.int32


@pytest.mark.parametrize("resolution", [1, 5, 8, 16, 24, 32, 37])
def test_voxels_are_those_that_reach_into_occupied_cells(resolution):
    occupancy = scattered(0.02)
    voxels = occupied_voxels(occupancy, resolution)
    size = occupancy.resolution
    # In whole numbers: voxel k covers [k size, (k + 1) size), cell c [c resolution, ...).
    low = voxels.new_tensor(range(resolution)) * size
    cells = occupancy.cells.nonzero().int() * resolution  # [N, 3]
    meets = (low[:, None, None] < cells + resolution) & (cells < low[:, None, None] + size)
    x, y, z = meets.unbind(dim=2)  # [G, N]
    want = (x[:, None, None] & y[None, :, None] & z[None, None]).any(dim=-1).nonzero()
    assert torch.equal(voxels.long(), want)


def test_the_largest_weight_of_a_voxel_is_that_over_all_rays(ball_scene, monkeypatch):
    """Traced in three chunks, of which the second has the largest weights."""
    monkeypatch.setattr("methods.students.voxels.CHUNK_RAYS", 10)
    batches = PixelBatches(ball_scene.splits["train"], torch.device("cpu"))
    voxels = Voxels(torch.cartesian_prod(*3 * [torch.arange(8, dtype=torch.int32)]), 8)
    weights, crossed, counts = iter((0.2, 0.7, 0.4)), [], []

    def weigh(rays, crossings):
        counts.append(len(rays.origins))
        crossed.append(crossings.voxel.unique())
        return torch.full((len(crossings.voxel),), next(weights))

    found = largest_weights(voxels, weigh, batches, 25, seeded(0), "cpu")
    assert counts == [10, 10, 5]
    want = torch.zeros(512)
    for chunk, weight in ((0, 0.2), (2, 0.4), (1, 0.7)):
        want[crossed[chunk].long()] = weight
    assert torch.equal(found, want)
    assert len(found.unique()) == 4  # 0 where no ray came
