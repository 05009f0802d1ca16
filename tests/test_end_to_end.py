"""What a new user does first: the demo, made small, as a process of its own."""

import json
import random
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import pandas as pd
import pytest

from bench.results import Store
from tests.sweeps.test_studies import page

pytestmark = pytest.mark.slow

SMALL = ["scene.width=64", "scene.train=6", "scene.test=3", "budget=tiny", "budget.frames=0"]
METHODS = ("ngp", "steernerf", "gaussians")
QUALITIES = {"psnr", "ssim", "lpips_alex"}
MEASURED_ANEW = ("frame_ms", "fps", "stage_ms", "train_", "compile_s", "peak_bytes")
"""Metrics that differ from one run to the next on any machine."""


def called(folder: Path, *words: str | Path) -> subprocess.CompletedProcess[str]:
    """`steerbench` with these words, called in a folder."""
    command = [Path(sys.executable).with_name("steerbench"), *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def demo(folder: Path, weights: Path, *more: str) -> subprocess.CompletedProcess[str]:
    return called(folder, "run", "+experiment=demo", *SMALL, f"weights_dir={weights}", *more)


def rows(folder: Path) -> pd.DataFrame:
    return Store(folder / "outputs").rows()


def repeatable(folder: Path) -> pd.DataFrame:
    """The rows that are the same whenever the same is measured on one machine."""
    table = rows(folder)
    kept = table[~table["metric"].str.startswith(MEASURED_ANEW)]
    return kept.sort_values(["method", "run", "phase", "metric"]).reset_index(drop=True)


@pytest.fixture(scope="module")
def first(tmp_path_factory, lpips_weights) -> tuple[Path, str]:
    """A folder in which the demo has run, and what it printed."""
    folder = tmp_path_factory.mktemp("first")
    done = demo(folder, lpips_weights)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


def test_the_table_and_the_report_compare_all_methods(first):
    outputs, printed = first[0] / "outputs", first[1]
    for word in ("PSNR", "SSIM", "LPIPS alex", "FPS", "model, MB", *METHODS):
        assert word in printed
    text = (outputs / "demo/report.md").read_text()
    pictures = list((outputs / "demo/pictures").glob("frames-*.png"))
    assert len(pictures) == 3
    assert f"![Ground truth, {', '.join(METHODS)}; a detail of each; error maps](" in text
    stages = ("march", "field", "feature_reprojection", "renderer2d")
    for word in (*(picture.name for picture in pictures), *stages):
        assert word in text


def test_the_same_seed_gives_the_same_rows(first, tmp_path, lpips_weights):
    assert demo(tmp_path, lpips_weights).returncode == 0
    kept = [repeatable(first[0]), repeatable(tmp_path)]
    assert {"psnr", "ssim", "lpips_alex", "work.samples"} <= set(kept[0]["metric"])
    pd.testing.assert_frame_equal(*kept, check_exact=True)


def test_every_kind_of_figure_is_what_a_program_without_our_code_finds(first, lpips_weights):
    """Of pictures it sees 8 bits, of the truth, too, which is scored as it is."""
    program = [sys.executable, "-I", Path(__file__).with_name("recompute.py")]
    weights = next(lpips_weights.glob("alexnet*"))
    command = [*program, first[0] / "outputs", weights]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    worst = json.loads(done.stdout.splitlines()[-1])
    of_pictures = {name: worst.pop(name) for name in list(worst) if name.startswith("picture: ")}
    assert {name.removeprefix("picture: ") for name in of_pictures} == QUALITIES
    assert max(of_pictures.values()) < 1e-3
    assert {*QUALITIES, "frame_ms", "fps", "stage_ms", "work", "sum of sizes"} <= worst.keys()
    assert max(worst.values()) < 1e-12


def test_training_is_shared_by_methods_and_runs_that_render_differently(first, lpips_weights):
    done = demo(first[0], lpips_weights, "method=ngp", "method.stop=1e-3")
    assert "trained field found" in done.stderr
    assert len(rows(first[0])["run"].unique()) == len(METHODS) + 1
    stages = [path.name.split("-")[0] for path in (first[0] / "outputs/stages").iterdir()]
    assert stages.count("field") == 1
    assert stages.count("steernerf") == 1


SMALLEST = [
    *("scene=totem", "scene.width=24", "scene.train=3", "scene.test=1"),
    *("budget=tiny", "budget.steps=16", "budget.samples=512", "budget.renderer_steps=8"),
    *("budget.frames=1", "protocol.name=quick", "protocol.lpips=[]", "protocol.warmup=0"),
    *("method.grid.levels=4", "method.grid.log2_table=10"),
    *("method.joint.patch=6", "method.joint.distilled_views=1"),
    *("method.joint.motion.pool=2", "method.joint.motion.uses=3"),
]


def mortal(folder: Path, last: int) -> subprocess.CompletedProcess[str]:
    """Two trainings of a 2D renderer, killed at the change `last` of a file; see mortal.py."""
    folder.mkdir(exist_ok=True)
    program = [sys.executable, "-P", Path(__file__).with_name("mortal.py"), str(last)]
    command = [*program, "table", "table5", *SMALLEST]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_wherever_it_is_killed_again_and_again_a_sweep_ends_with_the_same_rows(tmp_path):
    """Killed once in every fifth of what the undisturbed sweep does, somewhere in it."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    undisturbed = mortal(whole, 0)
    assert undisturbed.returncode == 0, undisturbed.stderr
    fifth, chance = int(undisturbed.stdout.split()[-1]) // 5, random.Random(0)
    moments = [part * fifth + chance.randint(1, fifth) for part in range(5)]
    for begun, end in pairwise([0, *moments]):
        life = mortal(killed, end - begun)
        assert life.returncode == -signal.SIGKILL, life.stderr
    last = mortal(killed, 0)
    assert last.returncode == 0, last.stderr
    assert "already measured" in last.stderr
    pd.testing.assert_frame_equal(*map(repeatable, (whole, killed)), check_exact=True)


def test_parity_compares_every_engine_that_is_here_with_torch_in_fp32(tmp_path, monkeypatch):
    done = called(tmp_path, "parity", *SMALLEST, "scene.test=3", "budget.frames=0")
    assert done.returncode == 0, done.stderr
    monkeypatch.chdir(tmp_path)
    shown = page("parity")
    apart = shown.loc["openvino, fp32", "PSNR to the first, dB ↑"]
    assert apart == "the same" or float(apart) > 60  # in 8 bits, but for one here and there
    assert shown.loc["torch, fp32", "lost, dB ↓"] == "0.000"
    assert abs(float(shown.loc["openvino, int8", "lost, dB ↓"])) < 1
    network, frame = (shown[f"{of}, ms ↓"].astype(float) for of in ("network", "frame"))
    assert ((network > 0) & (network < frame)).all()
