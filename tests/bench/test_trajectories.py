"""Trajectories go through the cameras of their split or file as they promise."""

import math
from dataclasses import replace
from itertools import chain, pairwise

import pytest
import torch

from bench.cameras import scale_camera
from bench.paths import write_path
from bench.trajectories import (
    Step,
    Trajectory,
    approached,
    follow,
    from_split,
    jump,
    leading,
    loop,
    orbit,
    smooth,
    spline,
    static,
)
from bench.types import Camera, Scene, Split
from tests.bench.test_motion import turn_deg
from tests.common import refusal
from tests.conftest import camera_on_orbit


def truths(path: Trajectory) -> list[int | None]:
    """The number of the picture of each frame, if it has one."""
    return [step.truth for step in path.steps]


def test_a_whole_split_is_rendered_in_its_order_with_its_ground_truth(tiny_scene):
    trajectory = from_split(tiny_scene)
    test = tiny_scene.splits["test"]
    assert [step.camera for step in trajectory.steps] == list(test.cameras)
    assert truths(trajectory) == list(range(6))
    assert (trajectory.name, trajectory.split, trajectory.resolution) == ("test", "test", "40x32")
    cameras = [scale_camera(test.cameras[0], 20, 16), *test.cameras[1:]]
    mixed = replace(tiny_scene, splits={"test": Split(cameras, test.images, test.names)})
    assert from_split(mixed).resolution == "mixed"


def test_a_limit_stands_in_the_name_and_cuts_before_a_frame_whose_predecessor_is_out(tiny_scene):
    thinned = from_split(tiny_scene, limit=3)
    assert truths(thinned) == [0, 2, 5]
    assert thinned.name == "test-3of6"
    assert from_split(tiny_scene, limit=99).name == "test"
    assert [step.cut for step in from_split(tiny_scene, limit=2).steps] == [False, True]
    steps = from_split(tiny_scene, limit=5).steps
    assert [step.truth for step in steps] == [0, 1, 2, 4, 5]
    assert [step.cut for step in steps] == [False, False, False, True, False]
    assert from_split(tiny_scene, limit=5).preceding == [0, 1, 2, 0, 1]
    assert from_split(tiny_scene, limit=2).preceding == [0, 0]


def test_a_split_that_is_not_there_or_empty_is_named_with_those_that_are(tiny_scene):
    empty = replace(tiny_scene, splits={**tiny_scene.splits, "val": Split([], [], [])})
    for scene in (tiny_scene, empty):
        with refusal("no frames in 'val'; it has train, test"):
            from_split(scene, "val")


def orbit_of(degrees: list[float]) -> Scene:
    """Cameras on a circle of radius 2 around the middle of the unit cube, looking at it."""
    cameras = [camera_on_orbit(angle / 360) for angle in degrees]
    images = [torch.zeros(32, 40, 4, dtype=torch.uint8)] * len(cameras)
    split = Split(cameras, images, [str(i) for i in range(len(cameras))])
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("orbit", {"test": split}, torch.ones(3), bounds, 1.0, "orbit")


def test_a_smooth_path_goes_through_the_cameras_in_even_steps():
    scene = orbit_of([0, 4, 7.5])
    path = smooth(scene)
    cameras = scene.splits["test"].cameras
    assert truths(path) == [0, None, None, None, 1, None, None, None, 2]
    assert [s.camera for s in path.steps if s.truth is not None] == list(cameras)
    turns = [turn_deg(a.camera, b.camera) for a, b in pairwise(path.steps)]
    assert turns == pytest.approx([1.0] * 4 + [3.5 / 4] * 4, abs=1e-3)
    for step in path.steps:
        distance = (step.camera.c2w[:, 3] - 0.5).norm().item()
        assert 2 * math.cos(math.radians(2)) - 1e-5 <= distance <= 2 + 1e-5
    path = smooth(orbit_of([0, 1, 2, 3]))  # close enough: no frame between them
    assert truths(path) == [0, 1, 2, 3]
    path = smooth(orbit_of([0, 1, 2, 3]), degrees=0.5, limit=2)
    assert truths(path) == [0, None, 1]
    assert path.name == "test-smooth0.5deg-2of4"


def test_a_smooth_path_is_even_also_where_cameras_only_move():
    """Aside by 0.2 and on by 0.1, of a distance of 2: what they look at moves by as many degrees as
    when they turn by as much."""
    scene = orbit_of([0, 0, 0])
    test = scene.splits["test"]
    right, _, ahead, _ = test.cameras[0].c2w.T
    for camera, move in zip(
        test.cameras[1:], (0.2 * right, 0.2 * right + 0.1 * ahead), strict=True
    ):
        camera.c2w[:, 3] += move
    # atan(0.1) is 5.7 degrees, atan(0.05) 2.9.
    assert truths(smooth(scene)) == [0, *[None] * 5, 1, *[None] * 2, 2]


def test_a_static_path_stays_where_it_is_and_an_orbit_takes_the_first_cameras():
    scene = orbit_of([0, 4, 8, 12])
    path = static(scene, view=1, frames=3)
    assert path.steps == (Step(scene.splits["test"].cameras[1], 1),) * 3
    path = orbit(scene, limit=3)
    assert path.steps == tuple(Step(scene.splits["test"].cameras[i], i) for i in range(3))
    assert (path.name, orbit(scene).name) == ("test-orbit-3of4", "test-orbit")
    assert not any(step.cut for step in path.steps)


def test_a_jumping_path_has_every_frame_once_and_a_cut_before_every_piece():
    scene = orbit_of(list(range(23)))
    there, jumping = smooth(scene), jump(scene, every=5)
    places = {id(step.camera): i for i, step in enumerate(there.steps)}
    order = [places[id(step.camera)] for step in jumping.steps]
    assert sorted(order) == list(range(23))
    assert [replace(step, cut=False) for step in jumping.steps] == [there.steps[i] for i in order]
    assert [step.cut for step in jumping.steps] == [i % 5 == 0 for i in order]
    for (before, after), step in zip(pairwise(order), jumping.steps[1:], strict=True):
        assert step.cut == (after != before + 1)
    assert jumping == jump(scene, every=5)
    assert jumping.name == "test-jump5-1deg"


@pytest.mark.parametrize("pieces", range(2, 12))
def test_no_number_of_pieces_is_too_small_to_shuffle(pieces):
    path = jump(orbit_of(list(range(pieces))), every=1, limit=pieces)
    assert all(step.cut for step in path.steps)
    assert all(after.truth != before.truth + 1 for before, after in pairwise(path.steps))


REFUSED = [
    (from_split, {"limit": -1}, r"limit: expected 0 \(all\) or more"),
    (smooth, {"degrees": 0}, "degrees: expected more than 0, got 0"),
    (static, {"view": 3}, "view: expected 0 to 2, the cameras of 'test', got 3"),
    (static, {"frames": 0}, "frames: expected 1 or more"),
    (loop, {"frames": 0}, "frames: expected 1 or more, got 0"),
    (jump, {"every": 3}, "every: expected 1 to 2, .* got 3"),
    (jump, {"every": 0}, "every: expected 1 to 2"),
    (spline, {"degrees": 0}, "degrees: expected"),
    *((make, {"degrees": math.inf}, "degrees: expected") for make in (smooth, spline)),
    (spline, {"keys": 1}, "keys: expected"),
    (approached, {"lead": -1}, "lead: expected 0 or more"),
    (approached, {"degrees": 0}, "degrees: expected more than 0"),
    (approached, {"degrees": math.nan}, "degrees: expected more than 0"),
    (approached, {"degrees": math.inf}, "degrees: expected more than 0, up to 180"),
]


@pytest.mark.parametrize(("make", "setting", "message"), REFUSED)
def test_a_setting_out_of_its_range_is_refused_by_name(make, setting, message):
    approach = {"split": "test", "lead": 3, "degrees": 3.3, "seed": 0, "limit": 0}
    settings = {approached: approach, spline: {"path": None}}.get(make, {}) | setting
    with refusal(r"trajectory\." + message):
        make(orbit_of([0, 1, 2]), **settings)


def test_a_loop_goes_there_and_back_until_its_frames_are_used_up():
    scene = orbit_of([0, 2, 4])
    path = loop(scene, frames=11)
    there = smooth(scene).steps
    for step, place in zip(path.steps, (0, 1, 2, 3, 4, 3, 2, 1, 0, 1, 2), strict=True):
        assert step.truth == there[place].truth
        assert torch.equal(step.camera.c2w, there[place].camera.c2w)
    assert not any(step.cut for step in path.steps)
    assert path.name == "test-loop11-1deg"
    scene = orbit_of([0, 1, 2])
    assert truths(loop(scene, frames=5, limit=2)) == [0, 1, 0, 1, 0]
    assert truths(loop(scene, frames=3, limit=1)) == [0, 0, 0]


def test_each_camera_is_approached_once_after_a_cut_from_a_motion_of_its_own(tiny_scene):
    path = approached(tiny_scene, "test", lead=2, degrees=3.3, seed=0, limit=0)
    cameras = tiny_scene.splits["test"].cameras
    assert truths(path) == [x for n in range(6) for x in (None, None, n)]
    assert [step.cut for step in path.steps] == [True, False, False] * 6
    assert [step.camera for step in path.steps if step.truth is not None] == list(cameras)
    assert path.preceding == [0, 1, 2] * 6  # steady for a method that looks back on `lead` frames
    starts = [turn_deg(step.camera, path.steps[0].camera) for step in path.steps[::3]]
    assert len({round(start, 1) for start in starts}) == 6
    turns = [turn_deg(a.camera, b.camera) for a, b in pairwise(path.steps) if not b.cut]
    assert turns == pytest.approx([3.3] * 12, abs=1e-3)
    path = approached(tiny_scene, "test", lead=0, degrees=3.3, seed=0, limit=0)
    assert [(step.truth, step.cut) for step in path.steps] == [(n, True) for n in range(6)]
    limited = approached(tiny_scene, "test", lead=1, degrees=3.3, seed=0, limit=3)
    assert truths(limited) == [None, 0, None, 2, None, 5]
    assert limited.name == "test-approached1-3.3deg-3of6"
    first, again, other = (approached(tiny_scene, "test", 1, 3.3, seed, 0) for seed in (0, 0, 1))
    poses = [[step.camera.c2w.tolist() for step in path.steps] for path in (first, again, other)]
    assert poses[0] == poses[1] != poses[2]
    assert first.name == again.name != other.name


def test_a_path_of_a_file_is_named_after_it_and_has_no_truths(tmp_path):
    scene = orbit_of([0, 4, 8])
    cameras = scene.splits["test"].cameras
    write_path(tmp_path / "there.json", cameras, scene)
    path = follow(scene, str(tmp_path / "there.json"), limit=2)
    assert path.name.startswith("there-")
    assert path.reads == (tmp_path / "there.json",)
    assert path.preceding == [0, 1]
    assert truths(path) == [None, None]
    torch.testing.assert_close(path.steps[1].camera.c2w, cameras[1].c2w)


def test_the_keys_of_a_spline_are_a_splits_cameras_or_those_of_a_file(tmp_path):
    scene = orbit_of([0, 4, 8, 12, 16])
    cameras = scene.splits["test"].cameras
    of_split = spline(scene, None, keys=3)
    assert [truth for truth in truths(of_split) if truth is not None] == [0, 2, 4]
    assert of_split.preceding[-1] == len(of_split.steps) - 1 > 2
    assert of_split.name == "test-3of5-spline1deg"
    write_path(tmp_path / "keys.json", cameras[:2], scene)
    of_file = spline(scene, str(tmp_path / "keys.json"))
    assert len(of_file.steps) > 2
    assert set(truths(of_file)) == {None}
    assert of_file.reads == (tmp_path / "keys.json",)


TARGET = torch.full((3,), 0.5)


def ring(degrees: list[float]) -> list[Camera]:
    return list(orbit_of(degrees).splits["test"].cameras)


def test_a_spline_goes_through_its_keys_in_even_steps_without_corners():
    keys = ring([0, 30, 50, 90])
    pieces = leading(keys, TARGET, degrees=1.0)
    assert [piece[-1] for piece in pieces] == keys[1:]
    for first, piece in zip(keys, pieces, strict=False):
        turns = [turn_deg(*pair) for pair in pairwise([first, *piece])]
        assert max(turns) <= 1.0 + 1e-2  # float32 poses
        assert min(turns) > 0.9 * max(turns)
    path = [keys[0], *chain(*pieces)]
    steps = torch.stack([camera.c2w[:, 3].double() for camera in path]).diff(dim=0)
    ways = torch.nn.functional.normalize(steps, dim=1)
    bends = (ways[1:] * ways[:-1]).sum(dim=1).clamp(max=1).acos().rad2deg()
    assert bends.max() < 2.0  # a circle bends by 1 degree a step, a chord's end by 25 or more


def test_a_camera_that_only_moves_is_led_in_steps_seen_from_the_target():
    (first,) = ring([0])
    aside = torch.cat((torch.zeros(3, 3), torch.tensor([[0.0], [1.0], [0.0]])), dim=1)
    (piece,) = leading([first, replace(first, c2w=first.c2w + aside)], TARGET, degrees=1.0)
    # Of moving by dy at a distance of sqrt(4 + y^2) the target sees dy / sqrt(4 + y^2).
    assert len(piece) == math.ceil(math.degrees(math.asinh(1 / 2)))


def test_a_spline_needs_different_keys_of_one_size():
    first, second = ring([0, 10])
    for keys in ([first], [first, first, second]):
        with refusal("two cameras"):
            leading(keys, TARGET, degrees=1.0)
    with refusal("of one size"):
        leading([first, scale_camera(second, 20, 16)], TARGET, degrees=1.0)
