"""How jobs end and what they leave behind; methods in turns; trainings side by side."""

import os
import pickle
from contextlib import nullcontext, suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest.mock import Mock

import pytest

import steerbench
from bench import waiting
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from sweeps import configured, execute
from sweeps.execute import Ended
from sweeps.hydra_runs import label
from sweeps.measurement import Job, NotStored, _read_by, became, obtain, stored
from sweeps.overrides import composed
from sweeps.plan import plan
from sweeps.processes import LOCKS, device_lock
from sweeps.versions import by_job
from tests.sweeps.conftest import HERE, STAND_INS
from tests.sweeps.test_plan import TABLES


@pytest.mark.parametrize(
    ("varied", "expected"),
    [
        ({"method": "ngp"}, "ngp"),
        ({"scene.seed": "1", "seed": "2"}, "ngp (scene.seed=1, seed=2)"),
        ({"scene.seed": "1"}, "ngp (seed=1)"),
    ],
)
def test_a_label_has_method_and_what_varies_by_whole_names_where_ends_are_alike(varied, expected):
    assert label("ngp", varied) == expected


def test_a_stored_run_that_cannot_be_read_is_the_failure_of_its_job(tmp_path, monkeypatch, capsys):
    cause = SteerbenchError("the cause")
    monkeypatch.setattr(execute, "obtain", lambda jobs: ([job.key for job in jobs], True))
    monkeypatch.setattr(execute, "say", Mock(side_effect=cause))  # of a stored run that is damaged
    job = Job(composed([f"outputs={tmp_path / 'outputs'}"]), [], "a job")
    ended = execute.attempt([(0, job)], 1, tmp_path / "sweep", 0.0)
    assert ended == {job.key: Ended(error=cause)}
    assert "failed: a job: the cause" in capsys.readouterr().err


class Diverged(Exception):
    def __init__(self, step: int, loss: float) -> None:  # cannot be read back from its message
        super().__init__(f"step {step}: {loss}")


@pytest.mark.parametrize(
    "error", [SteerbenchError("cause"), Unavailable("cause"), Diverged(3, 9.0)]
)
def test_any_error_of_a_job_comes_back_from_another_process(error):
    there = pickle.loads(pickle.dumps(Ended(error=error)))
    assert str(error) in str(there.error)
    assert there.failed == Ended(error=error).failed


# Several methods in turns, and what the store has of them


def in_turns(*levels: float, turns: str = "table") -> list[Job]:
    configs = [composed([*STAND_INS, f"method.level={level}"]) for level in levels]
    return [Job(config, [], turns=turns) for config in configs]


def measured(*levels: float) -> bool:
    return obtain(in_turns(*levels))[1]


def test_lines_that_are_measured_in_turns_are_found_together_or_not_at_all(elsewhere):
    """A table of times must not have one line of today beside one of last week."""
    assert measured(0.5, 0.75)
    assert len(stored(in_turns(0.5, 0.75))) == 2
    assert stored(in_turns(0.5, 0.25)) == {}
    assert measured(0.5, 0.25)
    assert not measured(0.75, 0.5)


def test_what_an_interruption_left_of_a_group_is_measured_again_with_the_rest(elsewhere):
    store = in_turns(0.5)[0].store
    (first, second), _ = obtain(in_turns(0.5, 0.75))
    mark = store.folder / first / "of yesterday"
    mark.touch()
    store.remove(second)
    assert stored(in_turns(0.5, 0.75)) == {}
    assert measured(0.5, 0.75)
    assert not mark.exists()
    assert list(stored(in_turns(0.5, 0.75))) == [first, second]


@pytest.mark.parametrize("broken", ["method.level=7", "device=cuda:99"])
def test_a_job_that_fails_is_left_out_and_the_others_are_measured_in_turns(
    broken, elsewhere, tmp_path, capsys
):
    """Whether its training fails, or it cannot be used here at all."""
    first, last = in_turns(0.5, 0.75)
    jobs = [first, Job(composed([*STAND_INS, broken]), [], "broken", turns="table"), last]
    for _ in range(2):
        ended = execute.attempt(list(enumerate(jobs)), 3, tmp_path, 0.0)
        error = ended.pop(jobs[1].key).error
        assert isinstance(error, SteerbenchError)
        assert jobs[1].failure.why == str(error)
    assert ended == {job.key: Ended(run) for run, job in stored([first, last]).items()}
    if broken.startswith("device"):  # what cannot be used here is not looked for
        assert stored(jobs) == stored([first, last])
    assert capsys.readouterr().err.count("failed: broken") == 2


def test_scenes_in_folders_of_one_name_are_refused_in_one_sweep(tmp_path):
    """Both would be the run of one scene."""
    folders = [tmp_path / part / "mic" for part in "ab"]
    jobs = [Job(composed(["scene=blender", f"scene.path={folder}"]), []) for folder in folders]
    with pytest.raises(SteerbenchError, match="expected folders with other names"):
        execute.run_jobs(jobs, Mock())


def test_a_failure_is_kept_for_its_job_until_that_succeeds(elsewhere):
    (job,), (other,) = in_turns(0.5, turns=""), in_turns(0.75, turns="")
    job.keep_failure(OSError("no room: \udce9"))  # of a name of a file that is no UTF-8
    assert (job.failure.why, other.failure) == (r"no room: \udce9", None)
    (timed,) = in_turns(0.5)
    assert timed.failure is None  # in turns it is another job
    obtain([job])
    assert job.failure is None


def test_a_command_that_succeeds_has_no_failure_left_of_other_defaults(elsewhere):
    """As of code that is taken back; which job it was, is forgotten with its default."""
    words = ["steerbench", "run", "method=grey"]
    tried, (taken_back,) = (
        Job(composed([*STAND_INS, "method.level=0.75"]), words),
        in_turns(0.5, turns=""),
    )
    tried.keep_failure(RuntimeError("it diverged"))
    obtain([taken_back])
    assert tried.failure
    obtain([replace(taken_back, command=[*words, "outputs=outputs"])])
    assert tried.failure is None


def test_a_training_after_one_that_spoilt_the_pictures_has_the_right_ones(monkeypatch, elsewhere):
    """They may be trained in one process, ahead of their jobs."""

    def blacken(method, scene, budget, log):
        for image in scene.splits["train"].images:
            image.fill_(0)

    def means(method, scene, budget, log):
        seen.append([image.float().mean().item() for image in scene.splits["train"].images])

    seen: list[list[float]] = []
    for fit in (means, blacken, means):
        monkeypatch.setattr("stand_ins.Grey.fit", fit)
        with suppress(SteerbenchError) if fit is blacken else nullcontext():
            configured.trained(composed(STAND_INS), ConsoleLog(Path("outputs")))
    assert seen[0] == seen[1]
    assert min(seen[0]) > 0


# Whether to measure


def test_what_is_stored_is_measured_again_where_that_is_asked_for(elsewhere):
    words = [*STAND_INS, "method.level=0.25"]
    first, again = (Job(composed([*words, *more]), []) for more in ([], ["store=always"]))
    (key,), _ = obtain([first])
    stored_at = first.store.record(key)["stored"]
    assert obtain([first]) == ([key], False)
    assert obtain([again]) == ([key], True)  # the same run: how it came to be is no setting
    assert first.store.record(key)["stored"] > stored_at
    assert stored([again]) == {}


def test_nothing_is_measured_where_the_store_must_have_it(elsewhere, run):
    (only,) = (Job(composed([*STAND_INS, "store=only"]), []),)
    with pytest.raises(NotStored, match=r"not in outputs/runs.*store=missing measures it"):
        obtain([only])
    assert only.failure is None  # nothing was tried
    assert not list(Path("outputs").glob("*/*"))
    assert "not in outputs/runs" in run("store=only").refused()
    run("-m", "seed=0,1").ok()
    assert run("-m", "seed=0,1", "store=only").ok().err.count("already measured") == 2
    assert run("-m", "seed=0,1,2", "store=only").err.count("failed: grey (seed=2)") == 1


def test_a_file_that_a_setting_names_counts_by_its_content(elsewhere):
    Path("weights.bin").write_bytes(b"1")
    settings = {"method": {"checkpoint": "weights.bin"}}
    method, path = Mock(reads=(), spec=["reads", "name"]), Mock(reads=())
    before = _read_by(method, path, settings)
    Path("weights.bin").write_bytes(b"2")
    assert _read_by(method, path, settings) != before


def test_a_damaged_run_is_measured_again(elsewhere):
    (job,) = in_turns(0.5, turns="")
    (key,), _ = obtain([job])
    picture = next((job.store.folder / key / "pictures").iterdir())
    picture.write_bytes(b"")
    assert obtain([job]) == ([key], True)
    assert picture.read_bytes()


@pytest.mark.parametrize("turns", ["", "table"])
def test_a_failure_is_kept_by_whatever_asks_for_the_run(turns, elsewhere):
    jobs = in_turns(0.5, 7, turns=turns)[-1 - bool(turns) :]
    with pytest.raises(SteerbenchError):
        obtain(jobs)
    assert [job.failure and "level" in job.failure.why for job in jobs][-1]


def test_what_stands_for_a_value_is_the_same_run_as_the_value(elsewhere):
    (by_itself,), _ = obtain([Job(composed(STAND_INS), [])])
    typed = Job(composed([*STAND_INS, "device=cpu"]), [])
    assert obtain([typed]) == ([by_itself], False)
    assert typed.store.record(by_itself)["made_of"]["config"]["device"] == "cpu"
    assert by_job(typed.store, pytest.fail)[typed.key][0].key == by_itself


def test_what_a_method_leaves_to_the_scene_is_shown_as_it_became(tiny_scene):
    jobs = [Job(composed([f"method.grid.log2_table={x}"]), []) for x in ("null", "17")]
    typed, became_17 = (
        became(job.settings, configured.build(job.config, "method"), tiny_scene) for job in jobs
    )
    assert typed == became_17
    assert typed["method"]["grid"]["log2_table"] == 17


# Turns on a device


@pytest.fixture
def seen(tmp_path, elsewhere, monkeypatch) -> list[tuple[str, list[int | None]]]:
    """What the stand-in did, and the threads of all that were in the queue."""
    monkeypatch.setenv(LOCKS, str(tmp_path))
    notes = []

    def note(name: str, call, *given):
        files = sorted(tmp_path.glob("steerbench-*.json"))
        notes.append((name, [waiting._read(file).threads for file in files]))
        return call(*given)

    from stand_ins import Grey

    for name in ("fit", "render"):
        call = getattr(Grey, name)
        monkeypatch.setattr(Grey, name, lambda *given, of=(name, call): note(*of, *given))
    return notes


def recorded(*words: str) -> dict:
    job = Job(composed([*STAND_INS, "scene.frames=1", "protocol.warmup=0", *words]), [])
    return job.store.record(obtain([job])[0][0])


def test_a_run_trains_on_its_threads_also_ahead_of_a_table_and_is_timed_alone(seen, quiet_log):
    with suppress(KeyError), device_lock("cpu", quiet_log):
        raise KeyError  # it leaves the queue all the same
    assert recorded("threads=1")["neighbours"]["exclusive"]
    execute._train(composed([*STAND_INS, "budget.threads=1"]))
    steerbench.fit(*STAND_INS, "budget.threads=1")
    renders = [("render", [None])] * 3  # the only frame, and twice to see whether it is random
    assert seen == [("fit", [1]), *renders, ("fit", [1]), ("fit", [1])]


def test_what_is_not_exclusive_waits_for_nobody_and_is_another_run(seen, quiet_log):
    alone = recorded()
    with device_lock("cpu", quiet_log):
        beside = recorded("exclusive=false")
    renders = [("render", [None])] * 3
    assert seen[4:] == [("fit", [None]), *renders]  # of whom it does not wait for
    assert not beside["neighbours"]["exclusive"]
    assert beside["made_of"]["config"] == {**alone["made_of"]["config"], "exclusive": False}
    jobs = [Job(composed([*STAND_INS, f"exclusive={x}"]), []) for x in ("true", "false")]
    assert len({job.key for job in jobs}) == 2
    assert len({execute._training(job) for job in jobs}) == 1


# Trainings side by side


@cache
def trainings(name: str) -> set[str]:
    """The different ones of the jobs of a table with one seed; composing them takes seconds."""
    jobs = plan(TABLES[name], ["budget=paper", "seed=0"])
    return {execute._training(job) for job in jobs}


def test_what_is_chosen_afterwards_is_no_training_of_its_own():
    """The engines, precisions and range reductions of Tables 1 and 2."""
    assert len(trainings("table1")) == 8  # seven methods beside SteerNeRF
    assert len(trainings("table2")) == 1
    assert trainings("table2") <= trainings("table1")


def test_nothing_is_trained_for_a_line_whose_fellow_is_measured(monkeypatch):
    """Say one that fails each time, at a precision that this CPU does not have."""
    every = plan(TABLES["table1"], ["budget=paper"])
    jobs = [job for job in every if job.place.line in ("int8", "int8_calibrated")]
    assert len(jobs) > len({execute._training(job) for job in jobs}) > 1
    measured = {execute._training(job): job.key for job in jobs}  # one of each training
    monkeypatch.setattr(execute, "room", lambda config: 2)
    monkeypatch.setattr(execute, "processes", None)  # it would be called
    execute.train_ahead(jobs, set(measured.values()))


def test_a_method_that_declares_nothing_is_trained_for_each_of_its_settings(monkeypatch):
    """A plug-in may train with a setting that others choose afterwards."""
    monkeypatch.syspath_prepend(HERE)
    configs = [composed([*STAND_INS, f"+method.stop={stop}"]) for stop in (0.1, 0.2)]
    assert len({execute._training(Job(config, [])) for config in configs}) == 2


@pytest.mark.parametrize(("name", "lines"), [("table3", 4), ("table4", 3), ("table5", 2)])
def test_each_line_of_an_ablation_is_a_training_of_its_own(name, lines):
    jobs = plan(TABLES[name], ["budget=paper", "seed=0,1"])
    assert len({execute._training(job) for job in jobs}) == 2 * lines


@pytest.mark.parametrize(
    ("threads", "device", "together"),
    [("1", "cpu", 6), ("4", "cpu", 1), ("3", "cpu", 2), ("null", "cpu", 1), ("1", "cuda", 1)],
)
def test_there_are_as_many_at_a_time_as_cores_have_room_for(threads, device, together, monkeypatch):
    """Beside smaller trainings on the CPU, too."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    kinds = ["budget.threads=1"], [f"budget.threads={threads}", f"device={device}"]
    small, asked = (Job(composed(words), []) for words in kinds)
    assert execute.room([asked]) == execute.room([small, asked]) == together


SMALL = [
    *("scene=totem", "scene.width=24", "scene.train=3", "scene.test=1", "trajectory=test"),
    *("budget=tiny", "budget.steps=4", "budget.samples=512", "budget.renderer_steps=8"),
    *("budget.threads=1", "method.joint.distilled_views=1"),
    *("protocol.name=quick", "protocol.lpips=[]", "protocol.warmup=0"),
]


@pytest.mark.slow
def test_what_was_trained_ahead_is_found_when_it_is_measured(steerbench, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1})
    outcome = steerbench("table", "table5", *SMALL).ok()
    assert "training 2 models, 2 at a time" in outcome.err
    assert outcome.err.count("trained in") == 2
    _, measured = outcome.err.split("1 of 2", 1)
    assert "training the 2D renderer: done" not in measured
    assert measured.count("training the 2D renderer: found in") == 2

    again = steerbench("table", "table5", *SMALL)
    assert "models" not in again.err
    assert again.err.count("already measured") == 2
