"""`steerbench render`: the pictures of a path, again from its own file, next to another method."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.paths import write_path
from bench.results import Store
from methods.gaussians import ply
from tests.common import write_json
from tests.methods.gaussians.test_ply import some

SCENE = ("scene=totem", "scene.width=24", "scene.train=3", "scene.test=3")
QUICK = ("budget=tiny", "budget.steps=4", "budget.samples=512", "budget.frames=2")
PROTOCOL = ("protocol.name=quick", "protocol.lpips=[]", "protocol.warmup=0")


def pictures(folder: str) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)).astype(int) for path in sorted(Path(folder).glob("*.png"))]


@pytest.mark.slow
def test_every_frame_of_a_run_is_written_and_its_path_can_be_followed(steerbench):
    steerbench("run", "method=ngp", *SCENE, *QUICK, *PROTOCOL).ok()
    (run,) = Store(Path("outputs")).rows()["run"].unique()

    outcome = steerbench("render", "--run", run[:6], "--to", "there").ok()
    assert "trained field found" in outcome.err
    there = pictures("there")
    assert [picture.shape for picture in there] == [(24, 24, 3)] * 2
    kept = Path("outputs/runs") / run / "pictures/0000-rendered.png"
    assert np.array_equal(np.asarray(Image.open(kept)), there[0])

    words = ["--run", run, "--path", "there/path.json", "--beside", "ngp", "--to", "again"]
    steerbench("render", *words).ok()
    for before, after in zip(there, pictures("again"), strict=True):
        left, right = after[:, :24], after[:, 24:]
        assert np.array_equal(left, right)  # the same method twice
        # Poses in float32, there and back: a ray that touches a cell's edge may miss a sample.
        assert np.abs(left - before).mean() < 0.5


def test_a_ply_file_and_a_path_need_no_scene(steerbench, tiny_scene):
    ply.write(some(), tiny_scene, Path("some.ply"))
    write_path(Path("path.json"), tiny_scene.splits["test"].cameras[:2], tiny_scene)
    words = ("method=ply", "method.options.file=some.ply", "--to", "there")
    steerbench("render", *words, "--path", "path.json").ok()
    assert [picture.shape for picture in pictures("there")] == [(32, 40, 3)] * 2
    assert not Path("outputs").exists()  # where an embedded scene would be
    frame = {"transform_matrix": torch.eye(4).tolist(), "camera_angle_x": 0.7}
    write_json(Path("bare.json"), {"frames": [frame]})
    said = steerbench("render", *words, "--path", "bare.json").refused()
    assert "frames[0]: expected w and h, or scene=" in said
