"""Boxes that never cut what is seen and fill the unit cube; pictures that are held out."""

import math
from dataclasses import replace
from unittest.mock import MagicMock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from bench.cameras import look_at
from bench.scenes.assemble import CELLS, Box, box_of_cameras, cube, hold_out, hull_box, tight
from bench.scenes.embedded import picture, pose_on_sphere, train_poses
from bench.scenes.embedded.raytrace import Part, Solids
from bench.scenes.embedded.solids import Ellipsoid
from bench.scenes.embedded.textures import plain
from bench.types import Camera, Scene, Split
from tests.common import assert_near, refusal


def with_training(scene: Scene, count: int) -> Scene:
    """`scene` with `count` different training pictures, called 0, 1, 2 ..."""
    camera, image = scene.splits["train"].cameras[0], scene.splits["train"].images[0]
    cameras = [replace(camera, fx=60.0 + index) for index in range(count)]
    images = [image.roll(index, dims=0) for index in range(count)]
    train = Split(cameras, images, [str(index) for index in range(count)])
    return replace(scene, splits={**scene.splits, "train": train})


@pytest.mark.parametrize(("count", "held"), [(8, [4]), (13, [4, 12])])
def test_each_training_picture_is_either_learned_from_or_held_out(tiny_scene, count, held):
    scene = with_training(tiny_scene, count)
    whole = scene.splits["train"]
    found = hold_out(scene, "validation", 8).splits
    rest = [place for place in range(count) if place not in held]
    for part, places in ((found["train"], rest), (found["validation"], held)):
        assert part.names == [str(place) for place in places]
        for place, camera, image in zip(places, part.cameras, part.images, strict=True):
            assert camera is whole.cameras[place]
            assert image is whole.images[place]
    assert found["test"] is scene.splits["test"]
    with refusal(r"split=validation: expected at least 8 .* got 7 of"):
        hold_out(with_training(tiny_scene, 7), "validation", 8)


def test_the_digest_says_that_and_what_is_held_out(tiny_scene):
    scene = with_training(tiny_scene, 16)
    digests = [hold_out(scene, "validation", every).digest for every in (8, 4, 8)]
    assert digests[0] == digests[2]
    assert len({scene.digest, *digests}) == 3
    other = replace(scene, digest="of other pictures")
    assert hold_out(other, "validation", 8).digest != digests[0]


SIZE, RED = 32, plain((1.0, 0.0, 0.0))


def camera(pose) -> Camera:
    return Camera(pose.float(), 45.0, 45.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


def hull_of(part: Part, poses: list) -> Box:
    """The hull of what cameras at `poses` see of a model of one part."""
    cameras = [camera(pose) for pose in poses]
    return hull_box(cameras, [picture(Solids([part]), c) for c in cameras], cube(1.5))


@given(
    st.tuples(*[st.floats(-0.6, 0.6)] * 3),
    st.tuples(*[st.floats(0.05, 0.5)] * 3),
    st.integers(0, 1000),
)
@settings(max_examples=15)
def test_no_point_of_the_surface_is_outside_the_hull(centre, radii, seed):
    box = hull_of(Part(Ellipsoid(radii), RED, centre), train_poses(8, seed))
    # The surface's outermost points are its centre +- its semi-axes.
    middle, reach = torch.tensor(centre).double(), torch.tensor(radii).double()
    assert (box.lower <= middle - reach).all()
    assert (box.upper >= middle + reach).all()


def test_the_hull_of_many_views_is_tight():
    poses = train_poses(24, 0) + [pose_on_sphere(k, -0.4) for k in range(6)]
    box = hull_of(Part(Ellipsoid((0.3, 0.3, 0.3)), RED), poses)
    # A pixel is 4 / 45 wide there; the hull has up to 2 of them and a cell of 3 / 64 more.
    slack = 2 * 4 / 45 + 2 * 3 / 64
    assert (box.upper - box.lower).max() <= (0.6 + 2 * slack) * 1.05


def test_cells_that_leave_the_picture_are_kept():
    # One view sees only the middle of space: what it does not see, it cannot rule out.
    narrow = Camera(pose_on_sphere(0.0, 0.0).float(), 400.0, 400.0, 16, 16, SIZE, SIZE)
    nothing = torch.zeros(SIZE, SIZE, 4, dtype=torch.uint8)
    box = hull_box([narrow], [nothing], cube(1.5))
    assert (box.lower <= -1.5).all()
    assert (box.upper >= 1.5).all()
    # A camera inside the space rules nothing out behind it.
    inside = Camera(torch.eye(4)[:3], 16.0, 16.0, 16, 16, SIZE, SIZE)
    box = hull_box([inside], [nothing], cube(1.5))
    assert box.lower[2] <= -1.5


@pytest.mark.parametrize("alpha", [0, 255])
def test_no_hull_without_a_mask(alpha):
    cameras = [camera(pose) for pose in train_poses(40, 0)]
    image = torch.full((SIZE, SIZE, 4), alpha, dtype=torch.uint8)
    assert hull_box(cameras, [image] * 40, cube(1.2)) is None
    assert hull_box(cameras, [image[..., :3]] * 40, cube(1.2)) is None


def test_a_much_larger_box_than_what_it_holds_is_made_tight():
    part = Part(Ellipsoid((0.2, 0.5, 0.1)), RED, (0.3, -0.2, 0.1))
    cameras = [camera(pose) for pose in train_poses(20, 3)]
    taken = MagicMock(described=[MagicMock(camera=c) for c in cameras])
    images = [picture(Solids([part]), c) for c in cameras]
    taken.__iter__.side_effect = lambda: iter(images)
    box, large = hull_box(cameras, images, cube(1.5)), tight(cube(48.0), taken)
    assert_near(large.lower, box.lower, atol=3 / CELLS)
    assert_near(large.upper, box.upper, atol=3 / CELLS)


def looking(*poses: tuple[Tensor, Tensor]) -> list[Camera]:
    """Cameras at the first of each pair, that look at the second."""
    up = torch.tensor([0.0, 0.0, 1.0])
    return [Camera(look_at(eye, at, up), 9.0, 9.0, 4.0, 4.0, 8, 8) for eye, at in poses]


def test_the_box_of_cameras_is_around_what_they_look_at_with_all_of_them_inside():
    middle = torch.tensor([10.0, -20.0, 5.0])
    away = [torch.tensor([math.cos(a), math.sin(a), 0.2]) * 3 for a in range(6)]
    box = box_of_cameras(looking(*((middle + x, middle) for x in away)))
    assert_near((box.lower + box.upper) / 2, middle.double(), atol=0.02)
    assert box.side == pytest.approx(6, rel=0.02)  # the farthest is at (3, 0, 0.6)
    # Parallel axes meet nowhere: the cameras themselves are what is known.
    row = [torch.tensor([float(x), 0.0, 0.0]) for x in range(-2, 3)]
    box = box_of_cameras(looking(*((eye, eye + torch.tensor([0.0, 1.0, 0.0])) for eye in row)))
    torch.testing.assert_close(box.lower, torch.full((3,), -2.0).double())
    torch.testing.assert_close(box.upper, torch.full((3,), 2.0).double())
    for eye in (row[0], away[0]):  # of one, whatever rounding leaves: something
        assert box_of_cameras(looking((eye, row[1]))).side == 2
