"""`steerbench score`: rows like any other, of two folders or of a scene."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from bench.results import STEADY, Store
from tests.bench.test_pictures import write

QUICK = ("protocol.name=quick", "protocol.lpips=[]")
SCENE = ("scene=totem", "scene.width=24", "scene.train=2", "scene.test=3")


@pytest.fixture
def folders(tmp_path) -> tuple[str, str]:
    """Two grey pictures that are 51 levels (0.2) too bright, and their truth."""
    for name, level in (("theirs", 151), ("true", 100)):
        grey = torch.full((16, 20, 3), level, dtype=torch.uint8)
        write(tmp_path / name, dict.fromkeys(("0.png", "1.png"), grey))
    return "theirs", "true"


@pytest.fixture
def scored(steerbench, folders) -> Callable[..., str]:
    """Score a folder of pictures against the true ones; the key of the run."""

    def score(folder, *words):
        outcome = steerbench("score", folder, "--truth", "true", *QUICK, *words).ok()
        return re.search(r"run (\w+)", outcome.out)[1]

    return score


def test_the_rows_stand_in_the_store_beside_those_of_runs(steerbench, folders):
    theirs, true = folders
    words = ("--sequence", "pictures=1")
    outcome = steerbench("score", theirs, "--truth", true, *QUICK, *words).ok()
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
    refused = steerbench("render", "--run", rows["run"].iloc[0])
    assert "expected one of `steerbench run`, got score" in refused.err


def test_the_same_pictures_are_the_same_run_and_others_are_another(scored):
    other = ["protocol.name=other", "protocol.warmup=1"]
    cases = ([], [], ["--name", "better"], other, ["pictures=0"])
    keys = [scored("theirs", *words) for words in cases]
    assert keys[0] == keys[1]
    assert len(set(keys)) == 4


def test_pictures_of_two_programs_are_compared_where_their_truth_is_the_same(steerbench, scored):
    keys = [scored(folder) for folder in ("theirs", "true")]
    compared = steerbench("compare", *(key[:6] for key in keys)).ok()
    assert "psnr" in compared.out
    assert steerbench("compare", *reversed(keys)).status == 1


def test_the_pictures_of_a_scene_are_its_own_truth(steerbench):
    assert steerbench("score", "nowhere", *SCENE, *QUICK).status == 2  # writes the scene
    (folder,) = Path("outputs/scenes").glob("totem-*/test")
    outcome = steerbench("score", str(folder), *SCENE, *QUICK, "--name", "exact").ok()
    rows = Store(Path("outputs")).rows().set_index("metric")
    # Its alpha is composited, and that rounded to 8 bit: at most half a level off.
    assert rows["value"]["psnr"] >= 20 * math.log10(255 / 0.5)
    assert "3 pictures with an alpha channel were put on white" in outcome.err
    first = rows.iloc[0]
    assert (first["scene"], first["split"], first["n"]) == ("totem-24x24-2train-3test", "test", 3)


def test_reported_times_are_in_the_rows_and_marked(steerbench, scored):
    Path("named.csv").write_text("frame_ms,name\n30,1\n10,0\n99,other\n")
    Path("plain.csv").write_text("frame_ms\n10\n30\n")
    keys = [scored("theirs", "--times", file) for file in ("named.csv", "plain.csv")]
    assert keys[0] == keys[1]
    store = Store(Path("outputs"))
    rows = store.rows().set_index("metric")
    assert rows["value"][["frame_ms", "fps"]].tolist() == [20, 50]
    assert rows["unit"]["frame_ms.p50"] == "ms"
    assert rows["phase"]["frame_ms.p50"] == rows["phase"]["frame_ms"] == STEADY
    assert set(rows["device"]) == {"reported"}
    assert store.frames(keys[0])["frame_ms"].tolist() == [10, 30]
    assert "reported" in steerbench("results").out


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("ms\n1\n", "expected a column frame_ms, got ms"),
        ("frame_ms\n1\n", "expected 2 lines, one for each picture, got 1"),
        ("frame_ms\n1\n-1\n", "frame_ms: expected numbers above 0"),
        ("name,frame_ms\n0,1\n2,1\n", "got none or several of 1"),
    ],
)
def test_times_that_do_not_fit_the_pictures_are_refused(steerbench, folders, text, said):
    Path("times.csv").write_text(text)
    words = ("--truth", "true", *QUICK, "--times", "times.csv")
    assert said in steerbench("score", "theirs", *words).refused()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--truth", "true", "scene=totem"], "--truth and scene=totem: expected one of them"),
        (["--truth", "true", "report=page"], "report: a page compares times"),
    ],
)
def test_what_cannot_be_scored_is_one_message(steerbench, folders, words, said):
    assert said in steerbench("score", folders[0], *words, *QUICK).refused()
