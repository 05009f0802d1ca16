"""`import steerbench`: the names that are documented, and the tour that shows them."""

import json
import os
import random
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import steerbench
from bench.isolation import put_back
from tests.common import ROOT, refusal

DOCS = ROOT / "docs"
QUICK = (
    *("method=ngp", "scene=totem", "scene.width=24", "scene.train=3", "scene.test=2"),
    *("budget=tiny", "budget.steps=4", "budget.samples=512"),
    *("protocol.name=quick", "protocol.lpips=[]", "protocol.warmup=0"),
)


def test_every_name_is_documented_and_every_documented_name_is_there():
    table = [line for line in steerbench.__doc__.splitlines() if line.startswith("| `")]
    named = [name for line in table for name in re.findall(r"`(\w+)`", line.split("|")[1])]
    assert sorted(named) == sorted(steerbench.__all__)
    for name in named:
        assert getattr(steerbench, name).__doc__


def test_a_run_is_measured_once_and_a_method_renders_what_it_measured(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = steerbench.run(*QUICK)
    again = steerbench.run(*QUICK, "report=page")
    assert again.key == run.key
    assert "ngp" in Path("page/report.md").read_text()
    assert len(steerbench.results()["run"].unique()) == 1
    assert run.label == "ngp"
    assert "| PSNR, dB" in run._repr_markdown_()

    camera = steerbench.load_scene(*QUICK).splits["test"].cameras[0]
    frame = steerbench.fit(*QUICK).render(camera, steerbench.NullProbe())
    kept = np.asarray(Image.open(run.pictures / "0000-rendered.png"))
    shown = (255 * frame.rgb.clamp(0, 1)).round().byte().numpy()
    assert np.array_equal(shown, kept)


def state() -> list:
    """What a user's own program may rely on."""
    numbers = torch.get_rng_state().tolist(), np.random.get_state()[1].tolist(), random.getstate()
    return [list(sys.argv), dict(os.environ), torch.get_num_threads(), *numbers]


def test_the_users_process_is_left_as_it_was_found(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["notebook", "cell"])
    torch.manual_seed(7)
    before, outputs = state(), f"outputs={tmp_path}"
    steerbench.run(*QUICK, "threads=2", outputs)
    steerbench.sweep(*QUICK, "threads=2", "seed=0,1", outputs)
    steerbench.fit(*QUICK, "threads=2", outputs)
    assert state() == before


def test_what_a_user_has_set_of_torch_changes_no_figure(tmp_path):
    """It is in no key."""
    usual = steerbench.run(*QUICK, f"outputs={tmp_path / 'usual'}")
    with put_back():
        torch.set_default_dtype(torch.float64)
        torch.set_float32_matmul_precision("medium")
        torch.set_grad_enabled(False)
        found = steerbench.run(*QUICK, f"outputs={tmp_path / 'set'}")
        assert torch.get_default_dtype() == torch.float64
        assert not torch.is_grad_enabled()
    assert found.key == usual.key
    assert found.values["psnr"] == usual.values["psnr"]


def test_a_scene_that_changed_on_disk_is_read_again(tmp_path):
    words = [*QUICK, f"outputs={tmp_path}"]
    first = steerbench.load_scene(*words)
    assert steerbench.load_scene(*words).digest == first.digest
    (file,) = tmp_path.glob("scenes/*/test/r_1.png")
    scene, digests = ["scene=blender", f"scene.path={file.parents[1]}"], {first.digest}
    for colour, shown in (("red", [255, 0, 0, 255]), ("blue", [0, 0, 255, 255])):
        Image.new("RGBA", (24, 24), colour).save(file)
        changed = steerbench.load_scene(*scene)
        assert changed.splits["test"].images[1][0, 0].tolist() == shown
        digests.add(changed.digest)
    assert len(digests) == 3
    file.rename(file.with_name("r_9.png"))
    with refusal("r_1"):
        steerbench.load_scene(*scene)


def test_what_is_handed_out_may_be_written_to_and_spoils_no_run(tmp_path):
    words = [*QUICK, f"outputs={tmp_path}"]
    psnr = steerbench.run(*words).values["psnr"]
    for split in steerbench.load_scene(*words).splits.values():
        for image in split.images:
            image.fill_(255)
    assert steerbench.run(*words, "pictures=1").values["psnr"] == psnr
    assert steerbench.run(*words, "pictures=2").values["psnr"] == psnr


def test_choices_come_with_what_they_are():
    assert steerbench.methods()["ngp"].startswith("Instant-NGP")
    assert "totem" in steerbench.scenes()


def cells() -> list[str]:
    notebook = json.loads((DOCS / "tour.ipynb").read_text(encoding="utf-8"))
    return ["".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"]


@pytest.mark.slow
def test_the_tour_runs(tmp_path):
    """Its cells one after the other; what the last line of a cell is, a notebook would show."""
    subprocess.run([sys.executable, "-c", "\n".join(cells())], cwd=tmp_path, check=True)


def test_the_import_changes_nothing_of_the_process():
    """The command line sets variables and the allocator for itself, not for who imports."""
    program = """
import os, torch, numba  # both set variables of their own
import bench.memory
bench.memory.keep_freed = None  # a call would fail
before = dict(os.environ)
import steerbench
assert dict(os.environ) == before, dict(os.environ).items() ^ before.items()
"""
    subprocess.run([sys.executable, "-c", program], check=True)
