"""Programs in other processes, from the command line: their rows, and their ends."""

import math
import os
import re
import shutil
from pathlib import Path
from textwrap import dedent

import pandas as pd
import psutil
import pytest

from tests.common import read_json
from tests.sweeps.conftest import CONFIGS, HERE, QUICK
from tests.sweeps.test_documents import DOCS, ROOT, write_files
from tests.sweeps.test_render import pictures

EXTERNAL = ["method=external", "method.command=worker.py"]
WHITE = [CONFIGS, *QUICK[1:]]
"""The stand-ins but for their method."""

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
def write(tmp_path):
    """Write `worker.py`: `GREY`, then further lines."""
    shutil.copy(ROOT / "steerbench_worker.py", tmp_path)

    def write(lines=""):
        (tmp_path / "worker.py").write_text(f"{dedent(GREY)}\n{dedent(lines)}\nserve(Grey)\n")

    return write


def rows(tmp_path: Path) -> pd.DataFrame:
    return pd.concat(map(pd.read_csv, tmp_path.glob("outputs/runs/*/rows.csv")))


@pytest.fixture
def documented(elsewhere, tmp_path) -> list[str]:
    """The files of external.md are in the working directory; the words that choose its method."""
    shutil.copy(ROOT / "steerbench_worker.py", tmp_path)
    shutil.copytree(HERE / "configs", tmp_path / "configs")  # Hydra takes one folder
    names = {"mean_worker.py", "configs/method/mine.yaml"}
    assert names < write_files("external.md", tmp_path)
    return ["--config-dir", "configs", "method=mine"]


def typed(begin: str) -> list[str]:
    """The words of the one command in external.md that begins so, without scene and budget."""
    (line,) = re.findall(rf"steerbench ({begin}.*)", (DOCS / "external.md").read_text())
    return [word for word in line.split() if not word.startswith(("scene=", "budget="))]


def test_the_worker_of_the_document_is_a_row_of_ten_lines(steerbench, documented, tmp_path):
    lines = (tmp_path / "mean_worker.py").read_text().splitlines()
    assert len([line for line in lines if line.strip()]) <= 10
    done = steerbench(*typed("run method=external method.command=mean"), *WHITE).ok()
    assert "frame, with the socket" in done.out
    table = rows(tmp_path).set_index("metric")
    assert table.loc["psnr", "value"] == math.inf  # white, as the scene is
    assert 0 < table.loc["frame_ms", "value"] < table.loc["wall_ms", "value"]
    assert set(table["backend"]) == {"external"}
    assert set(table["method"]) == {"Mean"}
    (record,) = tmp_path.glob("outputs/runs/*/record.json")
    assert read_json(record)["times"].startswith("read by the process that rendered")


def test_another_worker_or_another_option_is_another_run(run, write, tmp_path):
    counts = []
    for lines, option in (("", 0.5), ("", 0.25), ("CHANGED = 1", 0.25), ("CHANGED = 1", 0.25)):
        write(lines)
        assert run(*EXTERNAL, f"++method.options.level={option}").status == 0
        counts.append(len(list(tmp_path.glob("outputs/runs/*"))))
    assert counts == [1, 2, 3, 3]


def test_the_worker_of_the_document_has_a_line_in_a_table(steerbench, documented):
    words = typed("table table1 --config-dir")
    steerbench(*(word.replace("table1", "table9") for word in words), *WHITE, "seed=0").ok()
    assert "| mine |" in Path("outputs/table9/report.md").read_text()


def test_the_worker_of_the_document_is_drawn_along_a_path(steerbench, documented):
    steerbench("render", *documented, *WHITE, "--beside", "grey", "--to", "there").ok()
    for picture in pictures("there"):  # white as the scene, and beside it the grey
        assert (picture[:, :40] == 255).all()
        assert (picture[:, 40:] == 128).all()


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


def test_a_worker_beside_its_yaml_is_found_from_anywhere_and_gets_variables(
    steerbench, write, tmp_path
):
    write("""
        import os
        Grey.render = lambda self, camera: np.full(
            (camera.height, camera.width, 3), float(os.environ["LEVEL"]))
    """)
    shutil.copytree(HERE / "configs", tmp_path / "one/configs")
    for name in ("worker.py", "steerbench_worker.py"):
        shutil.move(tmp_path / name, tmp_path / "one/configs/method")
    mine = "defaults: [external, _self_]\ncommand: worker.py\nenvironment: {LEVEL: '1.0'}\n"
    (tmp_path / "one/configs/method/mine.yaml").write_text(mine)
    words = ["method=mine", *QUICK[1:], f"outputs={tmp_path / 'outputs'}"]
    steerbench("run", "--config-dir", str(tmp_path / "one/configs"), *words).ok()
    shutil.move(tmp_path / "one", tmp_path / "two")
    steerbench("run", "--config-dir", str(tmp_path / "two/configs"), *words).ok()
    assert len(list(tmp_path.glob("outputs/runs/*"))) == 1  # the key knows no folder
    psnr = rows(tmp_path).set_index("metric").loc["psnr", "value"]
    assert psnr == math.inf  # white, as the scene is
