"""`make gpu`, rehearsed to its end on a pretended GPU."""

import subprocess
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path

from docs import gpu as report
from sweeps.cli import dispatch, guard
from tests.common import read_json

TINY = [
    *("scene.width=16", "scene.train=4", "scene.test=2", "protocol.lpips=[]", "protocol.warmup=0"),
    *("budget.steps=2", "budget.samples=512", "budget.renderer_steps=1", "budget.frames=2"),
    *("method.grid.levels=2", "method.grid.log2_table=8", "method.training.grid_samples=512"),
    *("method.training.rays=64", "method.training.march_step=32", "pictures=0", "exclusive=false"),
]


def in_this_process(step: report.Step) -> subprocess.CompletedProcess[str]:
    """Where the pretended GPU is."""
    printed, said = StringIO(), StringIO()
    with redirect_stdout(printed), redirect_stderr(said):
        status = guard(dispatch, [*step.words])
    return subprocess.CompletedProcess(step.words, status, printed.getvalue(), said.getvalue())


def test_it_goes_to_its_end_and_says_what_failed(gpu, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(report, "ran", in_this_process)
    assert report.main(["--filter", "mlp", *TINY]) == 1
    ended = {file.stem: read_json(file)["done"][0] for file in Path("outputs/gpu").glob("*.json")}
    assert len(ended) == 8
    assert {name for name, status in ended.items() if status} == {"tensorrt-fp16", "tensorrt-int8"}
    text = Path("outputs/gpu/report.md").read_text()
    for said in ("0 failed", "Work of a frame", "pip install", "| torch-fp16 |"):
        assert said in text


def test_what_is_done_is_not_repeated(gpu, tmp_path, monkeypatch):
    taken = []

    def noted(step):
        taken.append(step.name)
        if step.name == "kernels" and taken.count("kernels") == 1:
            raise subprocess.TimeoutExpired("steerbench", step.limit_s, output=b"half")
        return subprocess.CompletedProcess(step.words, 0, "", "")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(report, "ran", noted)
    assert report.main([]) == 1
    assert "| stopped after 90 s |" in Path("outputs/gpu/report.md").read_text()
    assert report.main([]) == 0
    assert taken[8:] == ["kernels"]
    monkeypatch.setattr(report.provenance, "commit", lambda: "another")
    assert report.main([]) == 0
    assert len(taken) == 9 + 8
    assert sum(step.limit_s for step in report.steps([], [])) <= 720
