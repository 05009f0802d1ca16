"""What is exported for other programs, our own loaders read back as it was."""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor

from bench.layouts import LAYOUTS, POINTS, export
from bench.metrics import as_bytes
from bench.scenes import blender, colmap, embedded
from bench.scenes.export import data_camera
from bench.trajectories import Trajectory, follow, orbit, smooth
from bench.types import Camera, Scene, composite
from tests.common import ROOT, assert_near, read_json, refusal


@pytest.fixture
def scene(tmp_path, quiet_log) -> Scene:
    return embedded.load("totem", width=24, train=3, test=3, root=tmp_path / "all", log=quiet_log)


@pytest.fixture
def path(scene) -> Trajectory:
    """Three test views, and one true picture between each two that only the scene can render."""
    return smooth(scene, degrees=0.6)


def same_cameras(scene: Scene, found: Scene, split: str, wanted: Sequence[Camera]) -> None:
    for read, given in zip(found.splits[split].cameras, wanted, strict=True):
        camera, other = data_camera(found, read), data_camera(scene, given)
        assert_near(camera.c2w, other.c2w, atol=4e-6)  # float32, at 4.3
        lens, expected = ((x.fx, x.fy, x.cx, x.cy, x.width, x.height) for x in (camera, other))
        assert lens == pytest.approx(expected, rel=1e-9)


def truths(scene: Scene, path: Trajectory) -> list[Tensor]:
    images = scene.splits["test"].images
    return [scene.exact(s.camera) if s.truth is None else images[s.truth] for s in path.steps]


def test_the_layout_of_nerfbaselines_comes_back_with_its_path(scene, path, tmp_path, quiet_log):
    assert sum(step.truth is None for step in path.steps) == 2
    export(scene, path, tmp_path / "out", "nerfbaselines", quiet_log)
    found = blender.load(tmp_path / "out", log=quiet_log)
    same_cameras(scene, found, "test", [step.camera for step in path.steps])
    wanted = [*scene.splits["train"].images, *truths(scene, path)]
    images = [*found.splits["train"].images, *found.splits["test"].images]
    assert all(torch.equal(a, b) for a, b in zip(images, wanted, strict=True))
    assert (found.unit_length, found.origin.tolist()) == (scene.unit_length, scene.origin.tolist())
    cameras = (given.splits["train"].cameras for given in (found, scene))
    assert all(torch.equal(a.c2w, b.c2w) for a, b in zip(*cameras, strict=True))
    about = read_json(tmp_path / "out/nb-info.json")
    assert (about["id"], about["scene"]) == ("steerbench", scene.name)
    steps = follow(scene, str(tmp_path / "out/path.json")).steps
    for step, other in zip(steps, path.steps, strict=True):
        assert_near(step.camera.c2w, other.camera.c2w, atol=2e-6)


@pytest.mark.parametrize("far", [0.0, 5e6])
def test_a_colmap_model_comes_back_and_no_frame_of_the_path_is_in_it(
    scene, path, tmp_path, quiet_log, far
):
    pytest.importorskip("pycolmap")
    scene = replace(scene, origin=scene.origin + far)
    export(scene, path, tmp_path / "out", "colmap", quiet_log)
    # Every view is a test view in one of two loads: by default every eighth is.
    load = partial(
        colmap.load, split_every=2, bounds=[[far - 1.5] * 3, [far + 1.5] * 3], log=quiet_log
    )
    wanted = {"": scene.splits["train"].cameras, "test": [step.camera for step in path.steps]}
    pictures = {"": scene.splits["train"].images, "test": truths(scene, path)}
    for place, cameras in wanted.items():
        found = load(tmp_path / "out" / place)
        for split, part in (("test", slice(0, None, 2)), ("train", slice(1, None, 2))):
            same_cameras(scene, found, split, cameras[part])
            for image, true in zip(found.splits[split].images, pictures[place][part], strict=True):
                assert (image.numpy() == as_bytes(composite(true, scene.background))).all()


def test_the_points_of_a_colmap_model_fill_the_bounds(scene, path, tmp_path, quiet_log):
    export(scene, path, tmp_path / "out", "colmap", quiet_log)
    lines = (tmp_path / "out/sparse/0/points3D.txt").read_text().splitlines()
    points = torch.tensor([[float(x) for x in line.split()[1:4]] for line in lines]).double()
    corners = scene.origin + scene.unit_length * scene.bounds
    assert len(points) == POINTS
    assert_near(torch.stack((points.amin(0), points.amax(0))), corners, atol=5e-3)


def test_what_a_layout_cannot_hold_is_refused(scene, path, tmp_path, quiet_log):
    photographed = replace(scene, exact=None)
    with refusal("--path: expected a path whose frames all have true"):
        export(photographed, path, tmp_path / "b", "colmap", quiet_log)
    export(photographed, orbit(scene), tmp_path / "b", "blender", quiet_log)
    with refusal("expected a new or an empty folder"):
        export(scene, path, tmp_path / "b", "blender", quiet_log)
    black = replace(scene, background=torch.zeros(3))
    with refusal("expected square pictures on white"):
        export(black, path, tmp_path / "c", "nerfbaselines", quiet_log)


def test_the_choices_of_the_command_are_the_layouts():
    command = tomllib.loads((ROOT / "sweeps/commands.toml").read_text())["scenes"]
    assert command["arguments"]["--layout"]["choices"] == list(LAYOUTS)
