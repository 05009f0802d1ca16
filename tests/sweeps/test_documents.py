"""What the documents tell a reader to write, to type and to open exists and does what they say."""

import ast
import os
import re
import shlex
import sys
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import yaml
from omegaconf import OmegaConf

from reports.regression import LIMITS
from sweeps import cli, overrides
from sweeps.overrides import choices, composed, swept
from tests.common import ROOT

DOCS = ROOT / "docs"

SHOWN = re.compile(
    r"(?<=\n\n)(?:\d\. )?`([\w/]+\.(?:py|yaml|toml))`(?:(?!```).)*?\n *```\w+\n(.*?)\n *```\n",
    re.DOTALL,
)
"""A paragraph that begins with the name of a file, and the block below it."""

DOCUMENTS = sorted([*ROOT.glob("*.md"), *DOCS.glob("*.md")])
OLD = {"CHANGELOG.md", "RESULTS.md", "log.md"}
"""Documents that keep the names of their time."""

PRESENT = [path for path in DOCUMENTS if path.name not in OLD]

ELSEWHERE = (
    *("hydra", "--config-dir", "data="),
    *("method=mean_", "method=mine", "scene=npz", "scene.path=views.npz"),
)
"""What the words of a command begin with that need something that is not here."""


def named(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def write_files(document: str, folder: Path) -> set[str]:
    """Write the files that a document shows below `folder`; their names."""
    shown = SHOWN.findall((DOCS / document).read_text())
    for name, text in shown:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(dedent(text))
    return {name for name, _ in shown}


# The examples of extending.md


@pytest.fixture
def mine(tmp_path, monkeypatch) -> Path:
    """The folder that extending.md makes, with views of two greys."""
    written = write_files("extending.md", tmp_path)
    assert {"mean_colour/method.py", "mean_colour/average.py", "npz.py"} <= written
    assert {"configs/method/mean_colour.yaml", "configs/scene/npz.yaml"} <= written
    # Half of the views to learn from, of the value 102; the others are off by 26.
    pictures = np.full((4, 32, 40, 3), 102, np.uint8)
    pictures[2:] = 128
    poses = np.broadcast_to(np.eye(4)[:3], (4, 3, 4))
    np.savez(tmp_path / "views.npz", pictures=pictures, poses=poses, focal=40.0)
    monkeypatch.syspath_prepend(tmp_path)  # PYTHONPATH=.
    for name in ("mean_colour", "mean_colour.method", "mean_colour.average", "npz"):
        monkeypatch.delitem(sys.modules, name, raising=False)  # of another test's folder
    monkeypatch.chdir(tmp_path)
    return tmp_path


def typed(command: str) -> list[str]:
    """The words of the one command in extending.md that is `steerbench {command}`."""
    text = (DOCS / "extending.md").read_text()
    (line,) = re.findall(rf"PYTHONPATH=\. steerbench ({command} .*)", text)
    return shlex.split(line)


WITHOUT_LPIPS = ("protocol.lpips=[]", "protocol.name=quick")


def test_what_the_document_makes_is_listed_measured_and_studied(steerbench, mine):
    assert "The mean colour of the training pictures." in steerbench(*typed("list")).out
    measured = steerbench(*typed("run --config-dir"), *WITHOUT_LPIPS).ok()
    assert "19.83" in measured.out  # 20 log10(255 / 26)
    assert "paint" in measured.out
    refused = steerbench(*typed("run --config-dir"), *WITHOUT_LPIPS, "method.shade=2.0")
    assert refused.err.endswith("method: shade: expected 0 to 1, got 2.0\n")
    studied = steerbench(*typed("accuracy"), "protocol.rounds=2").ok()
    assert "shade 0.9" in studied.out


def test_the_table_of_the_document_is_measured_reported_and_the_same_sweep(steerbench, mine):
    words = typed("table shades --config-dir configs")
    steerbench(*words, *WITHOUT_LPIPS).ok()
    page = Path("outputs/shades/report.md")
    written = page.read_text()
    assert written.startswith("# Shades of the mean colour\n")
    assert "| method.shade=1.0 | **19.83** |" in written  # 20 log10(255 / 26)
    assert "seed 0 / 1" in written
    page.unlink()
    report = typed("report --config-dir configs --table shades")
    assert r"1.0 & \textbf{19.83}" in steerbench(*report, *WITHOUT_LPIPS).ok().out
    assert page.read_text() == written
    swept = steerbench(*typed("run -m"), *WITHOUT_LPIPS).ok()
    assert swept.err.count("already measured") == 4


# The gate of commands.md


def test_the_workflow_and_the_test_of_the_document_pass(steerbench, tmp_path, monkeypatch):
    text = (DOCS / "commands.md").read_text()
    (workflow,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    steps = [step.get("run", "") for step in yaml.safe_load(workflow)["jobs"]["check"]["steps"]]
    measure, check = (shlex.split(step)[1:] for step in steps if step.startswith("steerbench"))
    (tmp_path / "configs/method").mkdir(parents=True)
    grey = ROOT / "tests/sweeps/configs/method/grey.yaml"
    (tmp_path / "configs/method/mine.yaml").write_text(grey.read_text())
    steerbench(*measure, "scene.train=2", "scene.test=2").ok()
    steerbench("check", "--record", "baseline.json").ok()
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", "summary.md")
    steerbench(*map(os.path.expandvars, check)).ok()
    assert "as good as the baseline" in Path("summary.md").read_text()
    assert Path("check.xml").is_file()

    (test,) = re.findall(r"```python\n(import pytest.*?)```", text, re.DOTALL)
    names = {}
    exec(test, names)
    ((_, cases),) = [mark.args for mark in names["test_nothing_became_worse"].pytestmark]
    assert "psnr" in [one.metric for one in cases]
    for one in cases:
        names["test_nothing_became_worse"](one)


def test_the_limits_of_the_document_are_those_there_are():
    text = (DOCS / "protocol.md").read_text().partition("### Limits of")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(.*)` \| (.*) \| (everywhere)?.* \|$", text, re.MULTILINE)
    assert [(name, limit, not where) for name, limit, where in rows] == [
        (name, f"{x} {x.unit * (not x.relative)}".strip(), x.here) for name, x in LIMITS.items()
    ]


# All documents


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().split()) <= 700


@pytest.mark.parametrize("path", DOCUMENTS, ids=named)
def test_every_link_of_a_document_leads_somewhere(path):
    for target in re.findall(r"\]\(([^)\s]+)\)", path.read_text()):
        file, _, heading = target.partition("#")
        if not re.match(r"https?:", target):
            there = path.parent / file if file else path
            assert there.exists(), f"{target}: no such file"
            assert not heading or heading in headings(there), f"{target}: no such heading"


def headings(path: Path) -> set[str]:
    """The anchors of the headings of a document, as GitHub makes them."""
    lines = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", line.lower()).replace(" ", "-") for line in lines}


def commands(path: Path) -> list[list[str]]:
    """The words of every `steerbench` command in the shell blocks of a document."""
    blocks = re.findall(r"```sh\n(.*?)```", path.read_text(), re.DOTALL)
    lines = re.sub(r"\\\n\s*", " ", "".join(blocks)).splitlines()
    words = [shlex.split(line, comments=True) for line in lines]
    return [line[1:] for line in words if line[:1] == ["steerbench"]]


COMMANDS = [(named(path), words) for path in PRESENT for words in commands(path)]


def captured(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> Namespace:
    """What the command of `words` would be called with."""
    main = Mock(return_value=0)
    with monkeypatch.context() as patch:
        patch.setattr(cli.importlib, "import_module", lambda name: SimpleNamespace(main=main))
        assert cli.dispatch(words) == 0
    return main.call_args.args[0]


@pytest.mark.parametrize(
    ("document", "words"), COMMANDS, ids=lambda x: x if isinstance(x, str) else " ".join(x)
)
def test_every_command_of_a_document_can_be_typed(document, words, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("configs").mkdir()
    if words[0] == "run":
        settings = [word for word in words[1:] if "=" in word and not word.startswith("-")]
        if "-sc" in words:
            return
    else:
        options = captured(monkeypatch, words)
        settings = getattr(options, "overrides", [])
    settings = [word for word in settings if not word.startswith(ELSEWHERE)]
    several = swept(settings)
    settings = [word for word in settings if word.partition("=")[0] not in several]
    first = [f"{name}={values[0]}" for name, values in several.items()]
    if settings or first:
        assert composed([*settings, *first]).method


def test_every_command_there_is_has_an_example():
    examples = {words[0] for words in commands(DOCS / "commands.md")}
    assert examples == set(cli.COMMANDS)


GROUPS = ("method", "scene", "trajectory", "protocol", "budget", "engine")


def settings_there_are() -> set[str]:
    """Every setting, and every group of settings, of any choice."""
    found = set()
    for group in GROUPS:
        for name in choices(group):
            node = composed([f"{group}={name}"])[group]
            settings: Any = OmegaConf.to_container(node, resolve=False)
            for leaf in overrides.leaves(settings, f"{group}."):
                parts = leaf.split(".")
                found |= {".".join(parts[:n]) for n in range(1, len(parts) + 1)}
    return found


def test_every_setting_and_every_choice_of_a_document_exists():
    there, groups = settings_there_are(), "|".join(GROUPS)
    for path in PRESENT:
        text = path.read_text()
        for name in re.findall(rf"`((?:{groups})\.[a-z_0-9.]+)[`=]", text):
            assert name in there, f"{named(path)}: {name}"
        for group, name in re.findall(rf"`({groups})=(\w[\w-]*)[`\s]", text):
            if name not in {"my_engine", "mine"}:
                assert name in choices(group), f"{named(path)}: {group}={name}"


FILE = re.compile(r"`((?:[\w.-]+/)*[\w-]+\.(?:py|yaml|toml|txt|md|safetensors))`")
BESIDE = (".", "methods", "docs", "sweeps/configs")
"""Folders that names of files in documents are relative to."""
EXAMPLES = {"extending.md", "external.md"}
"""Documents that let a reader write files."""


@pytest.mark.parametrize("path", [p for p in PRESENT if p.name not in EXAMPLES], ids=named)
def test_every_file_of_a_document_exists(path):
    for name in FILE.findall(path.read_text()):
        if "/" in name and not re.match(r"outputs/|.*[A-Z]{4,}/", name):  # size/METHOD/BUDGET.yaml
            assert any((ROOT / folder / name).exists() for folder in BESIDE), name


def test_the_functions_that_implement_the_paper_are_where_the_document_says():
    pairs = re.findall(r"`([\w/]+\.py)`: `([\w.]+)`", (DOCS / "steernerf.md").read_text())
    assert len(pairs) > 15
    for file, name in pairs:
        source = (ROOT / "methods" / file).read_text()
        assert name in set(definitions(ast.parse(source))), f"{file}: {name}"


def definitions(node: ast.AST, prefix: str = "") -> Iterator[str]:
    """The classes and functions in a module, and the methods of its classes."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            yield f"{prefix}{child.name}"
            yield from definitions(child, f"{prefix}{child.name}.")


def test_every_equation_of_the_paper_has_a_place():
    text = (DOCS / "steernerf.md").read_text()
    numbers = re.findall(r"^\| (\d+) \|.*\| `[\w/]+\.py`: `", text, re.MULTILINE)
    assert [int(number) for number in numbers] == list(range(1, 12))
