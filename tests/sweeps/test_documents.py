"""What the documents tell a reader to write and to type does what they say."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path
from textwrap import dedent

import numpy as np

from reports import paper_tables
from sweeps import overrides
from sweeps.plan import chosen, plan

DOCS = Path(__file__).parents[2] / "docs"

SHOWN = re.compile(
    r"(?<=\n\n)(?:\d\. )?`([\w/]+\.(?:py|yaml|toml))`(?:(?!```).)*?\n *```\w+\n(.*?)\n *```\n",
    re.DOTALL,
)
"""A paragraph that begins with the name of a file, and the block below it."""


def write_files(document: str, folder: Path) -> set[str]:
    """Write the files that a document shows below `folder`; their names."""
    shown = SHOWN.findall((DOCS / document).read_text())
    for name, text in shown:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(dedent(text))
    return {name for name, _ in shown}


def test_the_method_and_the_scene_of_the_document_are_measured_from_outside_the_package(
    steerbench, tmp_path, monkeypatch
):
    written = write_files("extending.md", tmp_path)
    assert {"mean_colour.py", "npz.py", "configs/method/mean_colour.yaml"} <= written
    # Half of the views to learn from, of the value 102; the others are off by 26.
    pictures = np.full((4, 32, 40, 3), 102, np.uint8)
    pictures[2:] = 128
    poses = np.broadcast_to(np.eye(4)[:3], (4, 3, 4))
    np.savez(tmp_path / "views.npz", pictures=pictures, poses=poses, focal=40.0)
    monkeypatch.syspath_prepend(tmp_path)  # PYTHONPATH=.
    (typed,) = re.findall(r"PYTHONPATH=\. steerbench (.*)", (DOCS / "extending.md").read_text())
    without_lpips = ("protocol.lpips=[]", "protocol.name=quick")
    measured = steerbench(*shlex.split(typed), *without_lpips)
    assert measured.status == 0, measured.err
    assert "19.83" in measured.out  # 20 log10(255 / 26)
    assert "paint" in measured.out
    with (tmp_path / "mean_colour.py").open("a") as file:
        file.write("# changed\n")
    steerbench(*shlex.split(typed), *without_lpips)
    assert len(list(tmp_path.glob("outputs/runs/*/record.json"))) == 2
    refused = steerbench(*shlex.split(typed), *without_lpips, "method.shade=2.0")
    assert refused.err.endswith("method: shade: expected 0 to 1, got 2.0\n")


def test_the_table_of_the_document_is_planned(tmp_path, monkeypatch):
    for part in (overrides.CONFIGS, paper_tables.FOLDER):
        shutil.copytree(part, tmp_path / part.relative_to(DOCS.parent))
    assert len(write_files("experiments.md", tmp_path)) == 2
    monkeypatch.setattr(overrides, "CONFIGS", tmp_path / "sweeps" / "configs")
    monkeypatch.setattr(paper_tables, "FOLDER", tmp_path / "reports" / "paper")
    (table,) = chosen("table7")
    assert [job.line for job in plan(table, [])] == [line.label for line in table.lines]
