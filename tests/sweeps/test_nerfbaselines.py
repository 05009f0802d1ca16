"""Runs go to NerfBaselines and come back; its own reader accepts them, its own files are read."""

import base64
import json
import os
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.nerfbaselines import Prediction, write_results
from bench.results import Store
from bench.types import Camera

FIGURES = ("psnr", "ssim")


@pytest.fixture
def exported(run, steerbench) -> tuple[str, Path]:
    """The key of a stored run of two frames, and the folder that it was exported to."""
    assert run("pictures=2").status == 0
    (key,) = Store(Path("outputs")).rows()["run"].unique()
    steerbench("export", "nerfbaselines", key[:6], "--to", "theirs").ok()
    return key, Path("theirs")


def test_what_was_exported_is_imported_with_equal_figures(steerbench, exported):
    key, folder = exported
    files = ["import", "nerfbaselines", str(folder / "results.json")]
    for _ in range(2):  # the second time it is there
        outcome = steerbench(*files, "--beside", key).ok()
    assert "grey, imported" in outcome.out
    assert f"grey, run {key[:8]}" in outcome.out
    rows = Store(Path("outputs")).rows()
    ours, theirs = (
        rows[(rows["run"] == key) == mine].set_index("metric") for mine in (True, False)
    )
    assert set(theirs["device"]) == {"imported"}
    assert set(theirs["protocol"]) == {"nerfbaselines-default"}
    for metric in FIGURES:  # float32 in the file
        assert theirs["value"][metric] == pytest.approx(ours["value"][metric], rel=1e-6)
        assert theirs["n"][metric] == 2


def test_a_perfect_frame_keeps_its_infinite_psnr(run, steerbench):
    assert run("pictures=2", "method.level=1.0").status == 0  # white, as the scene is
    (key,) = Store(Path("outputs")).rows()["run"].unique()
    steerbench("export", "nerfbaselines", key, "--to", "theirs").ok()
    results = json.loads(Path("theirs/results.json").read_text())
    assert results["metrics"]["psnr"] == float("inf")  # as NerfBaselines itself writes it
    steerbench("import", "nerfbaselines", "theirs/results.json").ok()
    rows = Store(Path("outputs")).rows()
    imported = rows[rows["device"] == "imported"].set_index("metric")["value"]
    assert (imported["psnr"], imported["ssim"]) == (float("inf"), 1.0)


def test_the_files_are_those_of_the_run(exported):
    key, folder = exported
    results = json.loads((folder / "results.json").read_text())
    raw = base64.b64decode(results["metrics_raw"]["psnr"])
    assert np.frombuffer(raw, "<f4").tolist() == pytest.approx(
        Store(Path("outputs")).frames(key)["psnr"].tolist()
    )
    pictures = Path("outputs/runs") / key / "pictures"
    kept = sorted(path.read_bytes() for path in pictures.glob("*-rendered.png"))
    assert sorted(path.read_bytes() for path in folder.glob("predictions/color/**/*.png")) == kept
    cameras = [np.load(path) for path in folder.glob("predictions/cameras/**/*.npz")]
    assert [camera["poses"].shape for camera in cameras] == [(3, 4)] * 2


def test_what_cannot_be_exported_or_imported_is_named(run, steerbench, exported):
    assert run("pictures=1", "method.level=0.25").status == 0
    rows = Store(Path("outputs")).rows()
    (few,) = set(rows["run"]) - {exported[0]}
    for key, place, said in (
        (
            few,
            "other",
            "expected all 2 scored frames as pictures, got 1; measure it with pictures=2",
        ),
        (exported[0], "theirs", "theirs: expected a new or an empty folder"),
    ):
        assert said in steerbench("export", "nerfbaselines", key, "--to", place).refused()
    file = Path("theirs/results.json")
    whole = json.loads(file.read_text())
    for changes, said in (
        ({"metrics_sha256": "0"}, "metrics_sha256: expected"),
        ({"total": float("nan")}, "results.json: expected finite numbers"),
        ({"nb_info": None}, "nb_info: expected dict, got nothing"),
        ({"metrics_raw": {"psnr": "!"}}, "metrics_raw: expected float32 numbers in base64"),
    ):
        file.write_text(json.dumps(whole | changes))
        assert said in steerbench("import", "nerfbaselines", str(file)).refused()


THEIRS = """
import json
from pathlib import Path
import numpy as np
from nerfbaselines import metrics, new_cameras
from nerfbaselines.datasets import load_dataset
from nerfbaselines.evaluation import trajectory_get_cameras
from nerfbaselines.io import (deserialize_nb_info, get_metrics_hash, get_predictions_sha,
    load_trajectory, read_image, save_evaluation_results)
from nerfbaselines.results import _list_dataset_results, load_metrics_from_results

folder = Path("theirs")
((_, results),) = _list_dataset_results(folder, "steerbench")
lists = load_metrics_from_results(results)
shas = get_predictions_sha(str(folder / "predictions"))
assert shas == (results["predictions_sha256"], results["ground_truth_sha256"])
lists.pop("total_train_time")
assert get_metrics_hash(lists) == results["metrics_sha256"]
info = deserialize_nb_info(json.loads((folder / "predictions/info.json").read_text()))
assert info["dataset_metadata"]["background_color"].dtype == np.uint8
names = sorted(path.relative_to(folder / "predictions/color").with_suffix("")
               for path in folder.glob("predictions/color/**/*.png"))
for number, name in enumerate(names):
    pair = [read_image(folder / "predictions" / kind / name.with_suffix(".png")) / np.float32(255)
            for kind in ("color", "gt-color")]
    mse = metrics.mse(*(picture[None] for picture in pair))
    assert abs(metrics.psnr(mse)[0] - lists["psnr"][number]) < 0.01
    arrays = np.load(folder / "predictions/cameras" / name.with_suffix(".npz"))
    assert len(new_cameras(**arrays)) == 1
save_evaluation_results("back.json", metrics={"psnr": 21.5}, metrics_lists={"psnr": [21.0, 22.0]},
    predictions_sha="0", ground_truth_sha="1", evaluation_protocol="default",
    nb_info={**info, "method": "splatfacto", "total_train_time": 12.5})
scene = load_dataset("scene", "test")
path = trajectory_get_cameras(load_trajectory(open("scene/path.json")))
assert np.array_equal(path.poses, scene["cameras"].poses)
assert np.array_equal(path.intrinsics, scene["cameras"].intrinsics)
assert scene["images"][0].shape == (16, 16, 4) and len(scene["images"]) == 3
"""


@pytest.mark.slow
def test_nerfbaselines_reads_what_was_exported_and_is_read(steerbench, exported, nerfbaselines):
    sizes = "scene.width=16", "scene.train=2", "scene.test=3"
    where = "--to", "scene", "--layout", "nerfbaselines", "--path", "orbit"
    assert steerbench("scenes", "export", "totem", *where, *sizes).status == 0
    command = [nerfbaselines, "-c", THEIRS]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(command, capture_output=True, text=True, env=clean, check=False)
    assert done.returncode == 0, done.stderr
    steerbench("import", "nerfbaselines", "back.json").ok()
    rows = Store(Path("outputs")).rows()
    rows = rows[rows["method"] == "splatfacto"].set_index("metric")
    assert rows["value"].to_dict() == {"psnr": 21.5, "train_s": 12.5}


def test_figures_are_in_the_order_of_the_names_of_their_files(tmp_path):
    picture, camera = tmp_path / "grey.png", Camera(torch.eye(3, 4), 2.0, 2.0, 1.0, 1.0, 2, 2)
    Image.new("RGB", (2, 2)).save(picture)
    frames = [
        Prediction(f"r_{number}", picture, picture, camera, {"psnr": float(number)})
        for number in (2, 10)  # along a path
    ]
    data = {"evaluation_protocol": "default"}
    write_results(tmp_path / "there", frames, {}, data, datetime.now(UTC))
    raw = json.loads((tmp_path / "there/results.json").read_text())["metrics_raw"]["psnr"]
    assert np.frombuffer(base64.b64decode(raw), "<f4").tolist() == [10.0, 2.0]
