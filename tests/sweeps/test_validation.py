"""split=validation: no command trains on the pictures that it scores, or scores test pictures."""

import pytest

from bench.results import Store
from bench.types import Scene
from sweeps.measurement import described
from sweeps.overrides import composed
from sweeps.plan import plan
from sweeps.tables import chosen
from tests.sweeps.conftest import STAND_INS

SPLIT = "split=validation"
SIXTEEN = ("scene.frames=16", SPLIT)
HELD_OUT = ["view_4", "view_12"]


@pytest.fixture
def learned_from(steerbench, monkeypatch) -> list[Scene]:
    """The scenes that a grey was fitted to."""
    scenes = []
    monkeypatch.setattr("stand_ins.Grey.fit", lambda self, scene, *others: scenes.append(scene))
    return scenes


def test_a_run_scores_what_it_did_not_learn_from(run, learned_from, tmp_path):
    assert run(*SIXTEEN).status == 0
    (scene,) = learned_from
    assert not set(HELD_OUT) & set(scene.splits["train"].names)
    assert len(scene.splits["train"]) == 14
    store = Store(tmp_path / "outputs")
    rows = store.rows()
    assert set(rows["split"]) == {"validation"}
    assert set(rows["trajectory"]) == {"validation-approached3-3.3deg"}
    assert store.record(rows["run"].iloc[0])["scene"]["digest"] == scene.digest
    frames = store.frames(rows["run"].iloc[0])
    assert list(frames["name"].dropna()) == HELD_OUT
    assert len(frames) == 8


@pytest.mark.parametrize("command", ["accuracy", "skips", "parity", "breakdown", "scaling"])
def test_a_study_scores_what_it_did_not_learn_from(steerbench, learned_from, monkeypatch, command):
    monkeypatch.setattr("methods.checks.found", lambda name: [])
    words = [*STAND_INS, "method=shades", "engine=torch", "protocol=study-1", "protocol.rounds=2"]
    axis = ["--only", "N"] if command == "scaling" else []
    steerbench(command, *axis, *words, *SIXTEEN).ok()
    assert learned_from
    for scene in learned_from:
        assert list(scene.splits) == ["train"]
        assert not set(HELD_OUT) & set(scene.splits["train"].names)


@pytest.mark.parametrize("table", chosen(), ids=lambda table: table.name)
def test_every_job_of_the_paper_goes_to_the_held_out_views(table):
    assert {job.config.trajectory.split for job in plan(table, [SPLIT])} == {"validation"}


def test_a_sweep_over_the_split_measures_both(run, learned_from, tmp_path):
    assert run("-m", "scene.frames=16", "split=test,validation").status == 0
    assert set(Store(tmp_path / "outputs").rows()["split"]) == {"test", "validation"}
    assert sorted(len(scene.splits["train"]) for scene in learned_from) == [14, 16]


@pytest.mark.parametrize("path", ["trajectory=validation", "trajectory.split=validation"])
def test_a_path_to_held_out_views_holds_them_out_without_the_split(run, learned_from, path):
    assert run("scene.frames=16", path).status == 0
    assert [len(scene.splits["train"]) for scene in learned_from] == [14]


def test_the_split_is_its_trajectory_unless_that_was_asked_for():
    words = [SPLIT, "trajectory=smooth", "trajectory.split=validation", "trajectory.degrees=2"]
    assert composed(words).trajectory.degrees == 2
    assert composed([SPLIT, "trajectory=smooth"]).trajectory == composed([SPLIT]).trajectory
    assert described(composed([SPLIT])) == described(composed(["trajectory=validation"]))
    assert described(composed([SPLIT])) != described(composed([]))
    assert composed([SPLIT, "budget.frames=5"]).trajectory.limit == 5  # of the budget
