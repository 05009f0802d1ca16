"""Which run of the store a line shows: of the same settings, and of the very scene."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from bench.results import Store
from bench.types import Scene
from sweeps import configured, failures
from sweeps.commands.breakdown import with_engine
from sweeps.gather import gather, newest
from sweeps.identity import described
from sweeps.overrides import composed
from sweeps.plan import Planned, chosen, plan

(TABLE,) = (
    replace(table, lines=table.lines[:1], curve=False, beyond=None)
    for table in chosen(None, [])
    if table.name == "table5"
)


def job(folder: Path) -> Planned:
    return plan(TABLE, ["scene=blender", f"scene.path={folder}", "seed=0"])[0]


def shown(store: Store, folder: Path) -> list[str]:
    """Digests of the scenes of the runs in the line of the job that is asked for at `folder`."""
    ((line,),) = gather([job(folder)], newest(store), store.folder.parent).values()
    return [run.record["scene"]["digest"] for run in line.runs]


@pytest.fixture
def measured(store: Store, stored_run: str, tmp_path: Path) -> Store:
    """A store with the job measured in a/mic and then in b/mic, scenes that differ."""
    for number, name in enumerate("ab"):
        key = f"{number}{stored_run[1:]}"
        folder = shutil.copytree(store.folder / stored_run, store.folder / key)
        path = tmp_path / name / "mic"
        path.mkdir(parents=True)
        record = json.loads((folder / "record.json").read_text())
        record["made_of"] = {"config": described(job(path).config)}
        record["scene"]["digest"], record["scene_path"] = name, str(path)
        (folder / "record.json").write_text(json.dumps(record))
        rows = (folder / "rows.csv").read_text().replace(stored_run, key)
        (folder / "rows.csv").write_text(rows)
        os.utime(folder, (number, number))
    return store


@pytest.fixture
def content(monkeypatch: pytest.MonkeyPatch, tiny_scene: Scene) -> Callable[[str], None]:
    """Says what the digest of a scene is that is loaded; none may be loaded before that."""

    def none(node: str, root: Path) -> Scene:
        raise AssertionError(f"loads {node}")

    monkeypatch.setattr(configured, "_scene", none)
    return lambda digest: monkeypatch.setattr(
        configured, "_scene", lambda node, root: replace(tiny_scene, digest=digest)
    )


def test_of_folders_with_one_name_each_shows_its_own(measured, tmp_path, content):
    content("a")
    assert shown(measured, tmp_path / "a" / "mic") == ["a"]
    content("b")
    assert shown(measured, tmp_path / "b" / "mic") == ["b"]


def test_a_scene_that_lies_where_it_was_measured_is_not_loaded(measured, tmp_path, content):
    assert shown(measured, tmp_path / "b" / "mic") == ["b"]


@pytest.mark.parametrize(("digest", "found"), [("a", ["a"]), ("c", [])])
def test_a_scene_elsewhere_is_known_by_its_content(measured, tmp_path, content, digest, found):
    (tmp_path / "c" / "mic").mkdir(parents=True)
    content(digest)
    assert shown(measured, tmp_path / "c" / "mic") == found


def test_of_a_scene_that_is_not_here_the_last_run_is_shown(measured, tmp_path, content):
    assert shown(measured, tmp_path / "gone" / "mic") == ["b"]


def test_a_failure_stands_beside_what_was_measured_before(measured, tmp_path):
    asked = job(tmp_path / "b" / "mic")
    outputs = measured.folder.parent
    failures.keep(outputs, described(asked.config), "no such folder")
    ((line,),) = gather([asked], newest(measured), outputs).values()
    assert len(line.runs) == 1
    assert line.gaps == ["failed when it was tried again: no such folder"]


@pytest.mark.parametrize(("gpu", "engine"), [(False, "OpenVino"), (True, "TorchEngine")])
@pytest.mark.parametrize("asked", [[], ["engine=torch"]])
def test_the_engine_of_the_first_table_is_one_for_the_device(gpu, engine, asked, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    (table,) = (table for table in chosen(None, []) if table.name == "table1")
    targets = {job.config.engine._target_.split(".")[-1] for job in plan(table, asked)}
    assert targets == {"TorchEngine" if asked else engine}
    words = with_engine([*asked, "device=auto"])
    assert composed(words).engine._target_.split(".")[-1] in targets
