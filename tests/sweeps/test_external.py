"""Programs in other processes, from the command line: their rows, and their ends."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from pathlib import Path
from textwrap import dedent

import pandas as pd
import psutil
import pytest

from tests.sweeps.conftest import STAND_INS
from tests.sweeps.test_documents import DOCS, ROOT, write_files

EXTERNAL = ["method=external", "method.command=worker.py"]

GREY = """
    import numpy as np
    from steerbench_worker import serve

    class Grey:
        knobs = {"level": [0.25, 1.0]}

        def __init__(self, level=0.5):
            self.level = level

        def render(self, camera):
            return np.full((camera.height, camera.width, 3), self.level)
"""


@pytest.fixture
def write(tmp_path: Path):
    """Write `worker.py`, or another: `GREY`, then further lines."""
    shutil.copy(ROOT / "steerbench_worker.py", tmp_path)

    def write(lines: str = "", name: str = "worker.py") -> None:
        (tmp_path / name).write_text(f"{dedent(GREY)}\n{dedent(lines)}\nserve(Grey)\n")

    return write


def rows(tmp_path: Path) -> pd.DataFrame:
    return pd.concat(map(pd.read_csv, tmp_path.glob("outputs/runs/*/rows.csv")))


def test_the_worker_of_the_document_is_a_row(steerbench, tmp_path):
    assert "mean_worker.py" in write_files("external.md", tmp_path)
    shutil.copy(ROOT / "steerbench_worker.py", tmp_path)
    text = (DOCS / "external.md").read_text()
    (command,) = re.findall(r"steerbench (run method=external method.command=mean.*)", text)
    done = steerbench(*command.split()[:-2], *STAND_INS[:1], *STAND_INS[2:])
    assert done.status == 0, done.err
    assert "frame, with the pipe" in done.out
    table = rows(tmp_path).set_index("metric")
    assert table.loc["psnr", "value"] == math.inf  # white, as the scene is
    assert 0 < table.loc["frame_ms", "value"] < table.loc["wall_ms", "value"]
    assert set(table["backend"]) == {"external"}
    assert set(table["method"]) == {"Mean"}
    (record,) = tmp_path.glob("outputs/runs/*/record.json")
    assert json.loads(record.read_text())["times"].startswith("read by the process that rendered")


def test_a_worker_that_fails_is_one_line_and_the_others_of_a_sweep_run(run, write, tmp_path):
    write()
    write("raise SystemExit('no model here')", "broken.py")
    done = run("-m", "method=external", "method.command=broken.py,worker.py")
    assert done.status == 2
    failed = [line for line in done.err.splitlines() if "failed: " in line]
    assert len(failed) == 1
    assert "ended with status 1, 'hello' not answered; its last words: no model here" in failed[0]
    assert set(rows(tmp_path)["method"]) == {"Grey"}


def test_another_worker_or_another_option_is_another_run(run, write, tmp_path):
    counts = []
    for lines, option in (("", 0.5), ("", 0.25), ("'changed'", 0.25), ("'changed'", 0.25)):
        write(lines)
        assert run(*EXTERNAL, f"++method.options.level={option}").status == 0
        counts.append(len(list(tmp_path.glob("outputs/runs/*"))))
    assert counts == [1, 2, 3, 3]


def test_accuracy_turns_the_knobs_that_it_declares(steerbench, write, monkeypatch):
    write()
    monkeypatch.setattr("methods.checks.found", lambda name: [])  # no kernels
    done = steerbench("accuracy", *STAND_INS[:1], *STAND_INS[2:], *EXTERNAL, "--repeats", "1")
    assert done.status == 0, done.err
    assert "level 0.25" in done.out
    assert "level 1.0" in done.out


def test_when_steerbench_is_killed_the_worker_ends(spawn, write, tmp_path):
    write(f"""
    import os, threading

    def fit(self, job):
        with open({str(tmp_path / "pid")!r}, "w") as file:
            file.write(str(os.getpid()))
        threading.Event().wait()

    Grey.fit = fit
    """)
    os.mkfifo(tmp_path / "pid")
    process = spawn(*EXTERNAL)
    worker = psutil.Process(int((tmp_path / "pid").read_text()))
    process.kill()
    process.wait()
    worker.wait(60)
