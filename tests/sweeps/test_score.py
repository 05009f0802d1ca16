"""`steerbench score`: rows like any other, of two folders or of a scene."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
import torch
from PIL import Image

from bench.results import Store
from reports.trackers import TRACKERS

QUICK = ("protocol.name=quick", "protocol.lpips=[]")
SCENE = ("scene=totem", "scene.width=24", "scene.train=2", "scene.test=3")


@pytest.fixture
def folders(tmp_path: Path) -> tuple[str, str]:
    """Two grey pictures that are 51 levels (0.2) too bright, and their truth."""
    for name, level in (("theirs", 151), ("true", 100)):
        (tmp_path / name).mkdir()
        for number in (0, 1):
            image = torch.full((16, 20, 3), level, dtype=torch.uint8)
            Image.fromarray(image.numpy()).save(tmp_path / name / f"{number}.png")
    return "theirs", "true"


def test_the_rows_stand_in_the_store_beside_those_of_runs(steerbench, folders, monkeypatch):
    sent = []
    monkeypatch.setattr("reports.trackers.find_spec", lambda name: name)
    monkeypatch.setitem(TRACKERS, "wandb", lambda run, outputs: sent.append(run.label))
    theirs, true = folders
    words = ("--sequence", "pictures=1", "tracker=wandb")
    outcome = steerbench("score", theirs, "--truth", true, *QUICK, *words)
    assert outcome.status == 0, outcome.err
    assert "2 pictures, matched by name: 0.png is scored against 0.png" in outcome.err
    assert "PSNR" in outcome.out
    rows = Store(Path("outputs")).rows().set_index("metric")
    assert rows["value"]["psnr"] == pytest.approx(-20 * math.log10(0.2), abs=1e-5)
    assert rows["value"]["flicker"] == 0
    assert set(rows["method"]) == {"theirs"}
    assert set(rows["scene"]) == {"true"}
    record = Store(Path("outputs")).record(rows["run"].iloc[0])
    assert record["command"].startswith("steerbench score theirs --truth true --match name")
    assert steerbench("results", "--metric", "psnr").status == 0
    kept = {path.name for path in Path("outputs/runs").glob("*/pictures/*")}
    assert {name.split("-")[0] for name in kept} == {"0000"}
    assert sent == ["theirs"]


def test_the_same_pictures_are_the_same_run_and_others_are_another(steerbench, folders):
    theirs, true = folders
    keys = []
    for words in ([], [], ["--name", "better"], ["protocol.name=other", "protocol.ssim=uniform"]):
        outcome = steerbench("score", theirs, "--truth", true, *QUICK, *words)
        keys.append(re.search(r"run (\w+)", outcome.out)[1])
    assert keys[0] == keys[1]
    assert len(set(keys)) == 3


def test_pictures_of_two_programs_are_compared_where_their_truth_is_the_same(steerbench, folders):
    theirs, true = folders
    keys = []
    for folder in (theirs, true):
        outcome = steerbench("score", folder, "--truth", true, *QUICK)
        keys.append(re.search(r"run (\w+)", outcome.out)[1])
    compared = steerbench("compare", *keys)
    assert compared.status == 0, compared.err
    assert "psnr" in compared.out
    assert steerbench("compare", *reversed(keys)).status == 1


def test_the_pictures_of_a_scene_are_its_own_truth(steerbench):
    assert steerbench("score", "nowhere", *SCENE, *QUICK).status == 2  # writes the scene
    (folder,) = Path("outputs/scenes").glob("totem-*/test")
    outcome = steerbench("score", str(folder), *SCENE, *QUICK, "--name", "exact")
    assert outcome.status == 0, outcome.err
    rows = Store(Path("outputs")).rows().set_index("metric")
    # Its alpha is composited, and that rounded to 8 bit: at most half a level off.
    assert rows["value"]["psnr"] >= 20 * math.log10(255 / 0.5)
    assert "3 pictures with an alpha channel were put on white" in outcome.err
    assert (rows["scene"].iloc[0], rows["split"].iloc[0], rows["n"].iloc[0]) == ("totem", "test", 3)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--truth", "true", "scene=totem"], "--truth and scene=totem: expected one of them"),
        (["--truth", "nowhere"], "expected a folder"),
        (["--truth", "true", "protocol=none"], "none"),
        (["--truth", "true", "report=page"], "report: a page compares times"),
        ([*SCENE, "split=tests"], "expected test or validation"),
    ],
)
def test_what_cannot_be_scored_is_one_message(steerbench, folders, words, said):
    outcome = steerbench("score", folders[0], *words, *QUICK)
    assert outcome.status == 2
    assert said in outcome.err
