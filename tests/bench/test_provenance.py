"""The commit follows the checkout; the machine is described so that two can be distinguished."""

from __future__ import annotations

import json
import subprocess
from importlib import metadata
from pathlib import Path

import pytest
import torch

from bench import provenance

commit = provenance.commit.__wrapped__


@pytest.fixture
def checkout(monkeypatch, tmp_path) -> Path:
    """A copy of the project with one file in each package."""
    for package in ("bench", "methods", "sweeps"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "a.py").write_text("A = 1\n")
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "bench" / "a.py"))
    return tmp_path


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.org")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_a_checkout_names_its_commit_and_whether_it_was_changed(checkout):
    git(checkout, "init", "-q")
    git(checkout, "add", ".")
    git(checkout, "commit", "-q", "-m", "first")
    head = git(checkout, "rev-parse", "--short=12", "HEAD")
    assert commit() == head
    (checkout / "methods" / "a.py").write_text("A = 2\n")
    assert commit() == f"{head}-dirty"


def test_a_copy_installed_inside_another_repository_names_its_version(checkout):
    git(checkout, "init", "-q")
    git(checkout, "add", "sweeps")
    git(checkout, "commit", "-q", "-m", "a project that has steerbench in its .venv")
    assert commit() == metadata.version("steerbench")


def test_without_git_the_version_is_named(checkout, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert commit() == metadata.version("steerbench")


def test_the_machine_record_is_json_and_names_what_matters():
    record = json.loads(json.dumps(provenance.machine()))
    assert record["cuda"] == torch.version.cuda
    assert record["threads"] == torch.get_num_threads()
    assert record["cores"] >= 1
    assert record["memory_bytes"] > 1 << 28
    assert record["cpu"]
    assert len(record["gpus"]) == torch.cuda.device_count()


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("cpu family\t: 25\nmodel\t: 1\nmodel name\t: EPYC\n", "EPYC (family 25, model 1)"),
        ("CPU implementer\t: 0x41\nCPU part\t: 0xd40\n", "(CPU implementer 0x41, CPU part 0xd40)"),
    ],
)
def test_processors_of_one_name_are_distinguished(text, name, monkeypatch):
    monkeypatch.setattr(Path, "read_text", lambda path, *more, **options: text)
    assert provenance.machine()["cpu"].endswith(name)


def test_what_of_the_machine_can_change_a_figure_is_a_part_of_its_record():
    decisive = provenance.computed_by(str)["machine"]
    assert decisive.items() <= provenance.machine().items()
    assert not {"threads", "cores", "memory_bytes", "system"} & decisive.keys()
