"""`steerbench render`: the pictures of a path, again from its own file, next to another method."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bench.results import Store

SCENE = ("scene=totem", "scene.width=24", "scene.train=3", "scene.test=3")
QUICK = ("budget=tiny", "budget.steps=4", "budget.samples=512", "budget.frames=2")
PROTOCOL = ("protocol.name=quick", "protocol.lpips=[]", "protocol.warmup=0")


def pictures(folder: str) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)).astype(int) for path in sorted(Path(folder).glob("*.png"))]


@pytest.mark.slow
def test_every_frame_of_a_run_is_written_and_its_path_can_be_followed_and_timed(steerbench):
    steerbench("run", "method=ngp", *SCENE, *QUICK, *PROTOCOL).ok()
    (run,) = Store(Path("outputs")).rows()["run"].unique()

    outcome = steerbench("render", "--run", run[:6], "--to", "there").ok()
    assert "trained field found" in outcome.err
    there = pictures("there")
    assert [picture.shape for picture in there] == [(24, 24, 3)] * 2
    kept = Path("outputs/runs") / run / "pictures" / "0000-rendered.png"
    assert np.array_equal(np.asarray(Image.open(kept)), there[0])

    path = json.loads(Path("there/path.json").read_text())
    assert len(path["camera_path"]) == 2
    words = ["--run", run, "--path", "there/path.json", "--beside", "ngp", "--to", "again"]
    steerbench("render", *words).ok()
    for before, after in zip(there, pictures("again"), strict=True):
        left, right = after[:, :24], after[:, 24:]
        assert np.array_equal(left, right)  # the same method twice
        # Poses in float32, there and back: a ray that touches a cell's edge may miss a sample.
        assert np.abs(left - before).mean() < 0.5

    words = ("trajectory=path", "trajectory.path=there/path.json")
    steerbench("run", "method=ngp", *words, *SCENE, *QUICK, *PROTOCOL).ok()
    rows = Store(Path("outputs")).rows()
    timed = rows[rows["run"] != run].set_index("metric")
    assert timed["n"]["frame_ms"] == 2
    assert timed["n"]["psnr"] == 0  # without ground truth
