"""PlenOctree as a method: what is extracted, what it learns, what a training leaves."""

import math

import pytest
import torch

from bench.types import Scene
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.types import Pixels
from methods.plenoctree.method import OctreeTraining, PlenOctree, opaque_at_end
from methods.plenoctree.octree import Octree, extract, fibonacci_sphere
from tests.common import refusal, seeded
from tests.methods.conftest import Work
from tests.methods.small_students import extraction, fitted
from tests.methods.trainings import PIXEL, TAUGHT, TEACHER, quality, shows_the_ball
from tests.methods.usual import lessons


def mean_quality(method: PlenOctree, scene: Scene, split: str) -> float:
    return sum(quality(method, scene, split, view) for view in range(3)) / 3


def extracted(teacher: TrainedField, scene: Scene, **others: float) -> tuple[Octree, torch.Tensor]:
    """An octree, and the centres of its leaves."""
    batches = PixelBatches(scene.splits["train"], torch.device("cpu"))
    octree = extract(teacher, batches, extraction(**others), seeded(0))
    return octree, (octree.voxels.coordinates + 0.5) / 128


def test_a_ray_that_ends_is_opaque_and_keeps_its_colour_and_depth():
    alpha = torch.tensor([0.0, 0.5, 0.98, 0.995, 1.0])
    depth, colour = 3.0, torch.tensor([0.2, 0.4, 0.8])
    shown = opaque_at_end(Pixels(alpha[:, None] * colour, alpha * depth, alpha), stop=0.01)
    assert shown.alpha.tolist() == [*alpha[:3].tolist(), 1.0, 1.0]
    torch.testing.assert_close(shown.values, shown.alpha[:, None] * colour)
    torch.testing.assert_close(shown.depth_sum, shown.alpha * depth)


def test_leaves_stand_where_the_ball_is(ball_scene, teacher):
    octree, centres = extracted(teacher, ball_scene)
    assert teacher.occupancy.holds(centres).all()
    # Pixels are 1.6 / 40 wide: half of the leaves are not farther than two from the surface.
    away = ((centres - 0.5).norm(dim=1) - 0.3).abs()
    assert away.median() < 2 * PIXEL
    # Without the test of weights, all that the teacher takes for occupied would be there.
    assert len(octree.voxels) < 0.9 * int(teacher.occupancy.cells.sum())


@torch.no_grad()
def test_densities_are_means_of_the_teacher(ball_scene, teacher):
    octree, centres = extracted(teacher, ball_scene, points=16)
    axis = (torch.arange(4) + 0.5) / 4 - 0.5
    inner = torch.cartesian_prod(axis, axis, axis) / 128
    some = torch.arange(0, len(centres), len(centres) // 50)
    dense = torch.stack([teacher.field.density(x + inner)[0] for x in centres[some]])
    # Means of 16 and of 64 points are, but for chance, within 6 of their standard deviations.
    spread = dense.std(dim=1) * (1 / 16 + 1 / 64) ** 0.5
    difference = (octree.light.density[some] - dense.mean(dim=1)).abs()
    assert (difference < 6 * spread + 1e-3).all()


@torch.no_grad()
def test_harmonics_of_degree_0_are_the_mean_logit(ball_scene, teacher):
    octree, centres = extracted(teacher, ball_scene, degree=0)
    field = teacher.field
    _, geometry = field.density(centres[:100])
    towards = (field.encode_directions(d.expand(100, 3)) for d in fibonacci_sphere(8))
    shown = torch.stack([field.features(geometry, encoded)[:, :3] for encoded in towards])
    logits = shown.clamp(1e-3, 1 - 1e-3).logit().mean(dim=0)
    got = octree.light.harmonics[:100, 0] * (4 * math.pi) ** -0.5
    # Products of bfloat16 are rounded in another order: 2 ulps of 16 of its layers' sums.
    assert (got - logits).abs().median() < 0.02


def test_directions_are_spread_evenly():
    directions = fibonacci_sphere(64)
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(64))
    nearest = torch.cdist(directions, directions).fill_diagonal_(9).amin(dim=1)
    # 64 caps that cover the sphere without overlap would be (4 pi / 64)^(1/2) = 0.44 apart.
    assert 0.6 * 0.44 < nearest.min() <= nearest.max() < 1.4 * 0.44


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"resolution": 2048, "most_leaves": 1000}, "expected at most 1,000: choose a smaller"),
        ({"least_weight": 2.0}, "no leaf has a weight of 2"),
    ],
)
def test_too_many_leaves_and_none_are_refused(options, complaint, ball_scene, teacher):
    with refusal(complaint):
        extracted(teacher, ball_scene, **options)


@pytest.mark.slow
def test_it_learns_a_ball(ball_scene, shared_log):
    before, after = (fitted("plenoctree", ball_scene, shared_log, steps) for steps in (1, 60))
    assert mean_quality(after, ball_scene, "train") > mean_quality(before, ball_scene, "train") + 1
    # From the front of the ball, 1.6 - 0.3 from the camera, to its middle: after so few steps the
    # teacher's ball is a mist.
    shows_the_ball(after, ball_scene, 21, off=0.3)


def test_only_what_rays_meet_is_changed(ball_scene, teacher):
    octree, _ = extracted(teacher, ball_scene)
    before = octree.light.density.clone(), octree.light.harmonics.clone()
    options = lessons("plenoctree", max_rays=64)
    training = OctreeTraining(octree, ball_scene, TAUGHT, options, TEACHER)
    training.advance()
    met = torch.zeros(len(octree.voxels), dtype=torch.bool)
    met[training.visited.long()] = True
    assert 0 < met.sum() < len(met) / 2
    changed = (octree.light.harmonics != before[1]).flatten(1).any(dim=1)
    assert changed.any()
    assert not (changed & ~met).any()
    assert not ((octree.light.density != before[0]) & ~met).any()


def test_what_is_stored_is_chosen_afterwards(ball_scene, shared_log):
    half, full = (
        fitted("plenoctree", ball_scene, shared_log, 20, stored=kind) for kind in ("fp16", "fp32")
    )
    assert full.train_s == half.train_s  # the same training
    assert full.sizes()["leaves"] == 2 * half.sizes()["leaves"]
    shown = (mean_quality(method, ball_scene, "test") for method in (half, full))
    assert next(shown) == pytest.approx(next(shown), abs=0.05)
    work = Work()
    half.render(ball_scene.splits["test"].cameras[0], work)
    assert 0 < work.done["rays"] <= 32 * 32
    assert 0 < work.done["shaded_samples"] <= work.done["samples"]
