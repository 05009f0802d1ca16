"""The ray march against a plain loop over steps, and closed forms."""

import math

import pytest
import torch
from torch import Tensor

from bench.types import Rays
from methods.kernels.march import march
from methods.kernels.types import Occupancy
from tests.common import refusal, seeded

STEP = math.sqrt(3) / 1024
FULL = Occupancy(torch.ones(16, 16, 16, dtype=torch.bool))


def dust(seed: int) -> Occupancy:
    return Occupancy(torch.rand(32, 32, 32, generator=seeded(seed)) < 0.05)


def rays_through_the_cube(count: int) -> Rays:
    generator = seeded(5)
    origins = torch.rand(count, 3, generator=generator) * 3 - 1
    return Rays(origins, torch.rand(count, 3, generator=generator) - origins)


def plain_march(rays: Rays, phases: Tensor, grid: Occupancy) -> list[Tensor]:
    """All t_k inside the cube and an occupied cell, in float64, by ray."""
    origins = rays.origins.double()
    directions = rays.directions.double()
    faces = torch.stack((0 - origins, 1 - origins)) / directions
    near = faces.amin(dim=0).amax(dim=1).clamp(min=0)
    far = faces.amax(dim=0).amin(dim=1)
    numbers = torch.arange(1100) + phases[:, None]  # the diagonal has 1024
    steps = STEP / directions.norm(dim=1)
    found = []
    for ray, t in enumerate(near[:, None] + numbers * steps[:, None]):
        t = t[t < far[ray]]
        places = origins[ray] + t[:, None] * directions[ray]
        cells = (places * grid.resolution).long().clamp(0, grid.resolution - 1)
        found.append(t[grid.cells[cells.unbind(dim=1)]])
    return found


@pytest.mark.parametrize("jitter", [None, torch.linspace(0, 0.99, 40)])
def test_samples_are_the_steps_in_occupied_cells(jitter):
    """In the middle of a step, or at its share that is asked for."""
    grid, rays = dust(0), rays_through_the_cube(40)
    phases = torch.full((40,), 0.5) if jitter is None else jitter
    samples = march(rays, grid, STEP, jitter=jitter, backend="reference")
    counts, ray = samples.offsets.diff(), samples.ray.long()
    differing, parts = 0, samples.t.split(counts.tolist())
    for got, want in zip(parts, plain_march(rays, phases, grid), strict=True):
        common = torch.isclose(got[:, None].double(), want, rtol=0, atol=1e-5).any(dim=1).sum()
        differing += len(got) + len(want) - 2 * common
    # float32 puts a point that is within 1e-6 of a cell's face on either side of it; a step is
    # 1.7e-3, so a sample has such a face with a chance below 3 * 1e-6 * 32 / 1.
    assert len(samples) > 400
    assert differing <= 2
    assert torch.equal(ray, torch.arange(40).repeat_interleave(counts))
    places = rays.origins[ray] + samples.t[:, None] * rays.directions[ray]
    assert torch.equal(samples.positions, places)
    assert grid.holds(places).all()


@pytest.mark.parametrize("limit", [1, 40, 1024])
def test_a_window_leaves_samples_out_and_moves_none(backend, limit):
    grid = dust(4)
    rays = rays_through_the_cube(80)
    generator = seeded(6)
    jitter = torch.rand(80, generator=generator)
    near = torch.rand(80, generator=generator) * 2 - 0.5
    far = near + torch.rand(80, generator=generator) * 1.5 - 0.1  # some are empty
    far[::7], near[::5] = torch.inf, 0.0
    whole = march(rays, grid, STEP, jitter=jitter, backend=backend)
    near[3], far[4] = whole.t[whole.ray == 3][2], whole.t[whole.ray == 4][-1]  # the latter excluded
    how = {"window": torch.stack((near, far), dim=1), "jitter": jitter, "limit": limit}
    parts, start = [], torch.zeros(80, dtype=torch.int32)
    while (start >= 0).any():
        parts.append(march(rays, grid, STEP, start=start, backend=backend, **how))
        assert (parts[-1].offsets.diff() <= limit).all()
        start = parts[-1].resume
    ray = torch.cat([part.ray for part in parts])
    order = ray.argsort(stable=True)
    inside = (whole.t >= near[whole.ray.long()]) & (whole.t < far[whole.ray.long()])
    assert 0.1 < inside.float().mean() < 0.9
    assert torch.equal(ray[order], whole.ray[inside])
    assert torch.equal(torch.cat([part.t for part in parts])[order], whole.t[inside])
    positions = torch.cat([part.positions for part in parts])[order]
    assert torch.equal(positions, whole.positions[inside])


def test_rays_that_miss_or_make_no_sense_have_no_samples(backend):
    nan, inf = math.nan, math.inf
    origins = torch.tensor([[2.0, 2, 2], [0.5, 0.5, 0.5], [nan, 0, 0], [0.5, 0.5, 0.5], [0.5] * 3])
    directions = torch.tensor([[1.0, 0, 0], [0, 0, 0], [1, 0, 0], [nan, 1, 0], [inf, 1, 0]])
    samples = march(Rays(origins, directions), FULL, STEP, backend=backend)
    assert len(samples) == 0
    assert samples.resume.tolist() == [-1] * 5


def test_clearance_is_the_distance_to_the_nearest_brick_along_the_farthest_axis():
    cells = torch.zeros(32, 32, 32, dtype=torch.bool)
    cells[3, 17, 30] = cells[21, 20, 31] = True  # in the bricks (0, 4, 7) and (5, 5, 7)
    brick = torch.cartesian_prod(*3 * [torch.arange(8)])
    apart = [(brick - torch.tensor(of)).abs().amax(dim=1) for of in ((0, 4, 7), (5, 5, 7))]
    assert torch.equal(Occupancy(cells).clearance.flatten(), torch.minimum(*apart).to(torch.uint8))
    assert (Occupancy(torch.zeros_like(cells)).clearance == 8).all()


def test_wrong_arguments_are_named():
    origins = torch.zeros(2, 3)
    with refusal("directions: expected shape", ValueError):
        march(Rays(origins, torch.zeros(3, 3)), FULL, STEP)
    with refusal("step: expected a positive length, got 0", ValueError):
        march(Rays(origins, origins), FULL, 0.0)
    with refusal("limit: expected 1 or more, got 0", ValueError):
        march(Rays(origins, origins), FULL, STEP, limit=0)
    for side in (24, 1024):  # a clearance of 256 bricks would not fit into a byte
        with refusal(f"multiple of 16, at most 1008, got {side}", ValueError):
            Occupancy(torch.zeros(1, 1, 1).bool().expand(side, side, side))
