"""A method in a package of two modules outside the repository works with every command."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from bench import provenance

HELPER = "LEVEL = 0.5\n"
RENDERER = """
import torch

from bench.types import Frame
from mine.helper import LEVEL


class Mine:
    name = "mine"
    train_s = 0.0
    memory = 0

    def fit(self, scene, budget, log):
        pass

    def reset(self):
        pass

    def render(self, camera, probe):
        with probe.stage("paint"):
            size = camera.height, camera.width
            return Frame(torch.full((*size, 3), LEVEL), torch.ones(size), torch.ones(size))

    def sizes(self):
        return {"level": 4}

    def settings(self):
        return {"device": "cpu", "backend": "none", "engine": "none", "precision": "fp32"}
"""
SMALL = (
    *("scene=totem", "scene.width=16", "scene.train=2", "scene.test=2", "budget=tiny"),
    *("protocol.name=quick", "protocol.lpips=[]", "trajectory=test"),
)


@pytest.fixture
def folder(steerbench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of the package `mine` and the configuration of its method; all further calls find it."""
    package = tmp_path / "plug-in's" / "mine"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "helper.py").write_text(HELPER)
    (package / "renderer.py").write_text(RENDERER)
    config = package.parent / "configs" / "method" / "mine.yaml"
    config.parent.mkdir(parents=True)
    config.write_text("# Mine.\n_target_: mine.renderer.Mine\n")
    monkeypatch.syspath_prepend(package.parent)
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("methods.checks.found", lambda name: [])
    return package.parent


@pytest.fixture
def call(steerbench, folder: Path):
    """Call a command with the folder of the configuration."""
    return lambda command, *argv: steerbench(
        command, "--config-dir", str(folder / "configs"), *argv
    )


def keys(tmp_path: Path) -> set[str]:
    """The runs of the store."""
    return {path.parent.name for path in tmp_path.glob("outputs/runs/*/record.json")}


def test_a_change_in_a_module_is_a_new_run_of_a_new_process(call, folder, tmp_path, monkeypatch):
    first = call("run", "method=mine", *SMALL)
    assert first.status == 0, first.err
    assert call("run", "method=mine", *SMALL).err.startswith("already measured")
    for number, name in enumerate(("helper.py", "renderer.py"), 2):
        with (folder / "mine" / name).open("a") as file:
            file.write("# changed\n")
        refused = call("run", "method=mine", *SMALL)
        assert f"mine/{name} was changed while this process runs" in refused.err
        monkeypatch.setattr(provenance, "_first", {})  # as a new process
        assert call("run", "method=mine", *SMALL).status == 0
        assert len(keys(tmp_path)) == number


def test_a_folder_that_is_not_there_is_named(steerbench):
    for command in ("list", "report"):
        refused = steerbench(command, "--config-dir", "nowhere")
        assert refused.status == 2
        assert "--config-dir: expected a folder, there is none at nowhere" in refused.err


@pytest.mark.parametrize("command", ["run", "accuracy"])
def test_a_name_near_it_is_answered_with_it(call, command):
    refused = call(command, "method=mien")
    assert refused.status == 2
    assert "unknown method 'mien'. Did you mean mine?" in refused.err
    assert "There are: diver, gaussians, kilonerf, mine, nerf, ngp, nsvf, plenoctree" in refused.err


@pytest.fixture
def only_mine(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Measure nothing but the plug-in; the methods of all jobs."""
    from sweeps import jobs
    from sweeps.measurement import obtain

    names = []

    def some(group):
        names.extend(job.config.method._target_ for job in group.jobs)
        if names[-1] != "mine.renderer.Mine":
            raise RuntimeError("not measured here")
        return obtain(group)

    monkeypatch.setattr(jobs, "obtain", some)
    return names


def line_of(err: str) -> str:
    """The line of the plug-in in the table on the page that was written."""
    page = Path(re.search(r"report: (.*)", err)[1]).read_text()
    (line,) = [line for line in page.splitlines() if line.startswith("| mine |")]
    return line


@pytest.mark.slow
def test_table_1_has_a_line_for_it_that_is_measured_and_reported(call, only_mine, tmp_path):
    words = ("--table", "table1", "--with", "mine", *SMALL)
    measured = call("paper", *words)
    assert measured.status == 1  # the others failed
    assert only_mine.count("mine.renderer.Mine") == 1
    line = line_of(measured.err)
    assert re.search(r"\d\.\d\d / –", line)  # no published figure
    assert line_of(call("report", *words).err) == line
    assert len(keys(tmp_path)) == 1


def test_only_a_table_of_methods_takes_it(call):
    refused = call("report", "--table", "table3", "--with", "mine")
    assert refused.status == 2
    assert "--with: table3 compares no methods; table1 does" in refused.err
    unknown = call("report", "--with", "mein")
    assert "Did you mean mine?" in unknown.err
