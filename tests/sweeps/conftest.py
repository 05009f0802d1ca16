"""`steerbench` as a person would call it, in a directory of its own, with quick stand-ins."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hydra._internal.core_plugins.basic_launcher import BasicLauncher

from sweeps import cli

HERE = Path(__file__).parent
PATH = os.pathsep.join((str(HERE), str(HERE.parents[1])))
"""Where other processes find the stand-ins, and the code of this checkout."""

QUICK = ["method=grey", "scene=white", "budget=none", "protocol=quick"]
CONFIGS = f"--config-dir={HERE / 'configs'}"
STAND_INS = [CONFIGS, *QUICK]


class Outcome(NamedTuple):
    """What a call of `steerbench` left behind."""

    status: int
    out: str
    err: str

    def ok(self) -> Outcome:
        """Itself: it ended well."""
        assert self.status == 0, self.err
        return self

    def refused(self) -> str:
        """What was said: it was refused."""
        assert self.status == 2, self.err
        return self.err

    @property
    def json(self) -> Any:
        """What the last line of its output holds."""
        return json.loads(self.out.splitlines()[-1])


@pytest.fixture
def elsewhere(tmp_path, monkeypatch) -> None:
    """The working directory is `tmp_path`, and the stand-ins can be imported."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(HERE)


@pytest.fixture
def steerbench(elsewhere, monkeypatch, capfd) -> Callable[..., Outcome]:
    """Call the command line within this process, `elsewhere`."""
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # which `run` sets: restored after the test
    monkeypatch.setattr(sys, "argv", ["steerbench"])

    def call(*argv):
        try:
            status = cli.guard(cli.dispatch, list(argv))
        except SystemExit as ended:  # argparse and Hydra leave this way after --help
            status = int(ended.code or 0)
        return Outcome(status, *capfd.readouterr())

    return call


@pytest.fixture
def run(steerbench) -> Callable[..., Outcome]:
    """Call `steerbench run` with the stand-ins and further arguments."""
    return lambda *argv: steerbench("run", *STAND_INS, *argv)


@pytest.fixture
def launched(monkeypatch) -> list[int]:
    """How many jobs Hydra's usual launcher was handed, each time."""
    counts = []
    launch = BasicLauncher.launch

    def noted(self, jobs, initial_job_idx):
        counts.append(len(jobs))
        return launch(self, jobs, initial_job_idx)

    monkeypatch.setattr(BasicLauncher, "launch", noted)
    return counts


@pytest.fixture
def spawn(tmp_path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start `steerbench run` with the stand-ins as a process of its own in `tmp_path`; what still
    runs after the test is killed."""

    def start(*argv):
        process = subprocess.Popen(
            [Path(sys.executable).with_name("steerbench"), "run", *STAND_INS, *argv],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": PATH, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        left.callback(process.__exit__, None, None, None)
        left.callback(process.kill)
        return process

    with contextlib.ExitStack() as left:
        yield start
