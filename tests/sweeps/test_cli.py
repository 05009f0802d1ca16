"""The door: help, lists, results, and how the wrong word is answered."""

import io
import json
import os
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pandas as pd
import pytest
import torch

from bench.results import COLUMNS
from methods.kernels import BACKENDS
from sweeps.cli import COMMANDS


def test_without_a_command_the_help_shows_every_command_and_examples(steerbench):
    outcome = steerbench().ok()
    for word in (*COMMANDS, "+experiment=demo"):
        assert word in outcome.out


def test_the_version_is_that_of_the_package(steerbench):
    assert steerbench("--version").ok().out == f"{version('steerbench')}\n"


def test_help_of_run_lists_choices_settings_and_examples(run):
    outcome = run("--help").ok()
    methods = "method: dark, diver, external, gaussians, grey, kilonerf"
    for text in ("steerbench run -m seed=0,1,2", methods, "totem", "seed: 0", "-sc install"):
        assert text in outcome.out


def test_help_completion_and_list_answer_without_torch():
    program = (
        "import sys, sweeps.commands.run, sweeps.cli as cli; "
        "sys.exit(cli.dispatch(['list']) or 'torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)


@pytest.mark.parametrize(("terminal", "begins"), [(False, "## Choices\n\n| choice |"), (True, "┏")])
def test_tables_are_markdown_but_in_a_terminal(steerbench, monkeypatch, terminal, begins):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: terminal, raising=False)
    assert begins in steerbench("list").out


def test_list_shows_choices_backends_and_why_an_engine_cannot_be_used(steerbench, monkeypatch):
    monkeypatch.setitem(sys.modules, "openvino", None)
    out = steerbench("list", "--here").out
    choices = ("scene=blender", "+experiment=demo", "engine=torch", "engine=openvino")
    for text in (*choices, "NeRF-Synthetic", *(f" {name} " for name in BACKENDS)):
        assert text in out
    assert 'pip install -c constraints.txt -e ".[openvino]"' in out
    if not torch.cuda.is_available():
        why = "engine=tensorrt computes on a CUDA GPU, and torch sees none here"
        assert why in " ".join(out.split())


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["rsults"], "unknown command 'rsults'. Did you mean results?"),
        (["results", "--fromat", "csv"], "unknown argument '--fromat'. Did you mean --format?"),
        (["results", "--format", "cvs"], "invalid choice: 'cvs'"),
        (["kernels", "--repeats", "0"], "--repeats: expected 1 or more, got 0"),
        (["kernels", "--repeats", "many"], "--repeats: expected 1 or more, got many"),
        (["table", "tabel1"], "unknown table 'tabel1'. Did you mean table1"),
        (["scenes", "verify", os.curdir], "expected a folder chair or drums or"),
        (["scenes", "get", "lgeo"], "lego"),
        # Options and settings are read in any order.
        (["kernels", "scene=totem", "--repeats", "0", "budget=demo"], "--repeats: expected 1"),
        (["report", "budget=tiny", "--table", "table3", "sed=1"], "unknown setting 'sed'"),
        (["table", "table9"], "unknown table 'table9'. Did you mean table"),
        (["report", "seed=0", "--tabl3", "table3", "seed=1"], "Did you mean --table?"),
    ],
)
def test_a_wrong_word_is_answered_with_what_there_is(steerbench, argv, message):
    assert message in steerbench(*argv).refused()


def test_of_settings_around_an_option_the_last_one_counts(steerbench):
    refused = steerbench("report", "outputs=a", "--table", "table3", "outputs=b").refused()
    assert "b: there is no store" in refused


def test_results_are_the_same_in_every_format_and_can_be_narrowed_down(steerbench, run):
    assert "outputs: there is no store" in steerbench("results").refused()
    run("seed=4")
    # A commit or a key may consist of digits alone.
    names = {"run": "str", "commit": "str"}
    csv = pd.read_csv(io.StringIO(steerbench("results", "--format", "csv").out), dtype=names)
    loaded = pd.DataFrame(json.loads(steerbench("results", "--format", "json").out))
    table = steerbench("results").out
    assert list(csv.columns) == list(loaded.columns) == COLUMNS
    pd.testing.assert_frame_equal(csv, loaded, check_dtype=False, rtol=1e-14)
    for metric in csv["metric"]:
        assert metric in table
    out = steerbench("results", "--format", "csv", "--metric", "psnr", "--method", "grey").out
    assert pd.read_csv(io.StringIO(out))["metric"].tolist() == ["psnr"]
    assert "Did you mean psnr" in steerbench("results", "--metric", "psn").err


def test_bash_completes_what_follows_run(tmp_path, monkeypatch):
    """Through the function that `steerbench run -sc install=bash` defines, as on pressing TAB."""
    line = "steerbench run +experiment=d"
    script = f"""
        eval "$(steerbench run -sc install=bash)"
        COMP_LINE="{line}" COMP_POINT={len(line)} COMP_CWORD=2
        hydra_bash_completion
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent), prepend=os.pathsep)
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert (done.stdout.split(), done.stderr) == (["+experiment=demo"], "")
