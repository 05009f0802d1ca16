"""`steerbench run`: from overrides to a table, a stored run and a page, and how it is ended."""

import io
import json
import math
import shlex
import signal
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import torch

import steerbench as python
from tests.common import read_json, refusal
from tests.sweeps.conftest import CONFIGS, STAND_INS


def stored(tmp_path: Path) -> list[Path]:
    return sorted(path.parent for path in tmp_path.glob("outputs/runs/*/record.json"))


def records(tmp_path: Path) -> list[dict[str, Any]]:
    return [read_json(folder / "record.json") for folder in stored(tmp_path)]


def test_a_run_prints_its_table_and_is_stored_and_not_measured_again(run, tmp_path):
    first = run()
    assert (first.status, first.err) == (0, "")
    # Grey 0.5 rounds to 128/255: PSNR = -20 log10(127 / 255) = 6.05 dB.
    for text in ("6.05", "Quality", "Time of a frame", "Memory"):
        assert text in first.out
    (folder,) = stored(tmp_path)
    before = (folder / "rows.csv").stat()
    second = run("report=pages/first")
    assert (folder / "rows.csv").stat() == before
    assert f"already measured: {folder.name}" in second.err
    assert second.out == first.out
    assert "pages/first/report.md" in second.err
    assert "6.05" in (tmp_path / "pages/first/report.md").read_text()


@pytest.mark.parametrize(
    ("first", "second", "runs"),
    [
        ("method.level=0.5", "method.level=0.25", 2),
        ("scene.path=first", "scene.path=second", 2),
        ("scene.path=here/scene", "scene.path=moved/scene", 1),
        ("report=null", "report=elsewhere", 1),
    ],
)
def test_what_changes_rows_makes_another_run(run, tmp_path, first, second, runs):
    run(first)
    run(second)
    assert len(stored(tmp_path)) == runs


def test_another_content_of_a_file_that_the_method_reads_makes_another_run(run, tmp_path):
    for number, content in enumerate(("old", "new", "new"), 1):
        (tmp_path / "shade").write_text(content)
        run()
        assert len(stored(tmp_path)) == min(number, 2)


def test_the_record_holds_the_command_that_was_typed(run, tmp_path):
    run("seed=3", "scene.path=.")
    (record,) = records(tmp_path)
    command = record["command"]
    assert command.startswith("steerbench run ")
    assert command.endswith("seed=3 scene.path=.")
    assert f"{CONFIGS} method=grey" in command


def test_a_job_that_says_nothing_of_threads_has_the_usual_ones(run, tmp_path):
    usual = torch.get_num_threads()
    run("-m", "threads=2,null")
    had = {x["made_of"]["config"]["threads"]: x["machine"]["threads"] for x in records(tmp_path)}
    assert had == {2: 2, None: usual}


def test_a_sweep_takes_flags_after_overrides_and_leaves_nothing_but_outputs(run, tmp_path):
    assert run("seed=0,1", "-m", "scene.frames=2,3").status == 0
    assert len(stored(tmp_path)) == 4
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]
    assert {path.name for path in (tmp_path / "outputs").iterdir()} == {"runs", "stages", "sweeps"}


def test_a_job_that_fails_stands_in_the_table_and_on_the_page_and_the_others_run(run, tmp_path):
    outcome = run("-m", "method.level=0.5,7,0.25", "report=page")
    assert outcome.status == 2
    why = "method.level: expected 0 to 1, got 7"
    assert f"failed: grey (level=7): {why}" in outcome.err
    for text in (outcome.out, (tmp_path / "page/report.md").read_text()):
        assert f"grey (level=7): failed: {why}" in text
        assert "6.05" in text
    assert len(stored(tmp_path)) == 2


ABLATION = ("-m", "method.level=0.5,0.25", "seed=0,1")


def test_an_ablation_is_a_table_over_seeds_in_every_form_and_grows_by_what_is_new(run, tmp_path):
    table = run(*ABLATION, "report=page", "--format", "markdown").ok().out
    assert "| method | level | seeds | PSNR, dB ↑ |" in table
    assert "| grey | 0.5 | 2 | **6.05** |" in table
    page = (tmp_path / "page/report.md").read_text()
    assert table.partition("\n\n")[2].strip() in page
    assert "means over seeds" in page
    keys = stored(tmp_path)
    latex = run(*ABLATION, "--format=latex").ok().out
    assert r"grey & 0.5 & 2 & \textbf{6.05}" in latex
    figures = pd.read_csv(io.StringIO(run("--format", "csv", *ABLATION).ok().out))
    assert figures[["level", "seeds", "psnr.half"]].to_numpy().tolist() == [
        [0.5, 2, 0],
        [0.25, 2, 0],
    ]
    assert json.loads(run(*ABLATION, "--format", "json").out)[0]["seeds"] == 2
    assert stored(tmp_path) == keys
    grown = run(*ABLATION, "backend=auto,reference").ok().out
    assert grown.count("| grey |") == 4
    assert set(keys) < set(stored(tmp_path))
    assert "invalid choice: 'word'" in run("--format", "word").refused()


def test_a_sweep_and_a_run_of_the_store_are_frames_in_python(elsewhere):
    runs, table = python.sweep(*STAND_INS, *ABLATION[1:])
    assert table[["method", "level", "seeds"]].to_numpy().tolist() == [
        ["grey", "0.5", 2], ["grey", "0.25", 2]
    ]  # fmt: skip
    assert table["psnr"].round(2).tolist() == [6.05, 2.51]
    rows = python.results()
    assert rows.groupby("run")["method.level"].unique().str[0].to_dict() == {
        run.key: level for run, level in zip(runs, ["0.5", "0.5", "0.25", "0.25"], strict=True)
    }
    first, *_, last = [python.load(run.key[:10]) for run in runs]
    assert first.psnr_to(first) == math.inf
    # Between 128/255 and 64/255: PSNR = -20 log10(64 / 255) = 12.01 dB.
    assert round(first.psnr_to(last), 2) == 12.01
    with refusal("expected 0 to 1, got 7"):
        python.sweep(*STAND_INS, "method.level=0.5,7")


@pytest.mark.parametrize("form", [["--outputs", "there"], ["--outputs=there"], ["outputs=there"]])
def test_a_store_is_named_in_either_form(run, steerbench, tmp_path, form):
    run(*form).ok()
    assert list(tmp_path.glob("there/runs/*/record.json"))
    assert "grey" in steerbench("results", *form).ok().out


def test_more_threads_than_cores_are_named(run):
    assert "threads=500: more than the" in run("threads=500").ok().err


def test_a_sweep_whose_jobs_all_fail_has_a_table_and_no_page(run, tmp_path):
    outcome = run("-m", "method.level=7,8", "report=page")
    assert outcome.status == 2
    assert outcome.out.count("failed: method.level") == 2
    assert not (tmp_path / "page").exists()


def test_a_sweep_says_how_far_it_is_and_ends_with_one_table_and_one_page(run, tmp_path):
    outcome = run("-m", "method=grey,dark", "report=page").ok()
    told = [line for line in outcome.err.splitlines() if " dB, " in line]
    assert told[0].startswith("grey: 6.05 dB, ")
    assert "; 1 of 2 jobs done, about 0:00:0" in told[0]
    # Grey 0.25 rounds to 64/255: PSNR = -20 log10(191 / 255) = 2.51 dB.
    assert told[1].startswith("dark: 2.51 dB, ")
    assert told[1].endswith("; 2 of 2 jobs done")
    assert outcome.out.count("Comparison") == 1
    assert "Time of a frame" not in outcome.out
    assert outcome.err.count("report: ") == 1
    assert (tmp_path / "page/report.md").read_text().startswith("# grey, dark on white")
    assert len(list((tmp_path / "page/pictures").iterdir())) == 3 + 2  # the plots, two frames


def test_a_sweep_in_turns_measures_together_what_differs_in_the_method_alone(run, tmp_path):
    outcome = run("-m", "method.level=0.5,0.25,7", "seed=0,1", "in_turns=true")
    assert outcome.status == 2
    assert outcome.err.count("failed: grey (level=7") == 2
    made_of = [record["made_of"] for record in records(tmp_path)]
    assert len(made_of) == 4
    for seed in (0, 1):
        beside = {tuple(x["beside"]) for x in made_of if x["config"]["seed"] == seed}
        assert [len(keys) for keys in beside] == [2]
    assert run("-m", "method.level=0.5,0.25", "seed=0,1").status == 0
    assert len(stored(tmp_path)) == 4 + 4  # alone they are other runs


def test_a_folder_named_after_what_is_swept_gets_a_page_of_its_own(run, tmp_path):
    run("-m", "scene.frames=2,3", "seed=0,1", "report=pages/${scene.frames}")
    for frames in (2, 3):
        text = (tmp_path / f"pages/{frames}/report.md").read_text()
        assert text.startswith("# grey on white")
        assert f"scene.frames={frames}" in text
        assert f"scene.frames={5 - frames}" not in text


@pytest.mark.parametrize("folder", ["outputs/sweeps", "shared"])
def test_a_second_sweep_is_read_from_the_store_and_knows_nothing_of_the_first(
    run, tmp_path, folder
):
    run("-m", "seed=0,1,2", f"hydra.sweep.dir={folder}")
    again = run("-m", "seed=0,1", f"hydra.sweep.dir={folder}")
    assert "seed=2" not in again.out
    assert "2 of 2 jobs done" in again.err
    assert "about" not in again.err
    assert len(stored(tmp_path)) == 3
    assert len(list((tmp_path / folder).iterdir())) == 2


@pytest.mark.parametrize(
    ("overrides", "methods"), [([], ["grey", "dark"]), (["method=dark"], ["dark"])]
)
def test_an_experiment_may_be_a_sweep_and_words_narrow_it(steerbench, tmp_path, overrides, methods):
    outcome = steerbench("run", CONFIGS, "+experiment=table9", *overrides).ok()
    assert f"{len(methods)} of {len(methods)} jobs done" in outcome.err
    text = (tmp_path / "outputs/greys/report.md").read_text()
    assert text.startswith(f"# {', '.join(methods)} on white")


def test_a_sweep_that_cannot_begin_is_one_line(run, tmp_path):
    outcome = run("-m", "seed=0,1", "sed=1")
    assert (outcome.status, outcome.out) == (2, "")
    assert "Did you mean seed" in outcome.err
    assert stored(tmp_path) == []


def test_a_sweep_has_one_folder_of_outputs_for_its_table(run):
    refused = run("-m", "outputs=a,b").refused()
    assert "outputs: expected one folder, for the table of all jobs, got a, b" in refused
    (word,) = shlex.split(refused.partition("in quotes inside quotes, ")[2])
    run("-m", "seed=0", word).ok()


def test_equal_jobs_share_a_line(run):
    outcome = run("-m", "precision=fp32,bf16").ok()  # of a method without an engine
    assert outcome.out.count("| grey |") == 1


def test_outputs_that_cannot_be_written_are_named(run, tmp_path):
    (tmp_path / "a-file").touch()
    refused = run("outputs=a-file/below").refused()
    assert "a-file/below" in refused
    assert "outputs=DIR" in refused


# How a run ends that does not end by itself


@pytest.fixture
def hanging(spawn, tmp_path):
    """A run that is in the middle of its training."""
    (tmp_path / "hang").touch()
    process = spawn()
    assert process.stderr.readline() == "hanging\n"
    (tmp_path / "hang").unlink()
    return process


@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [(signal.SIGTERM, 143, ""), (signal.SIGINT, 130, "steerbench: interrupted\n")],
)
def test_a_signal_ends_a_run_through_its_clean_up(hanging, tmp_path, sent, status, said):
    hanging.send_signal(sent)
    out, err = hanging.communicate()
    assert (hanging.returncode, out, err) == (status, "", said)
    assert len(list(tmp_path.glob("outputs/stages/*/cleaned-up"))) == 1
    assert list(tmp_path.glob("outputs/runs/*")) == []


@pytest.mark.slow
def test_a_reader_that_goes_away_ends_the_run_quietly(spawn):
    process = spawn()
    process.stdout.close()
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait() == 141
