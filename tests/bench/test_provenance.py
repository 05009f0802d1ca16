"""The code digest follows the sources, the commit follows the checkout."""

from __future__ import annotations

import importlib
import json
import subprocess
from importlib import metadata
from pathlib import Path

import pytest
import torch

from bench import provenance
from bench.types import Camera

code_digest, commit = provenance.code_digest.__wrapped__, provenance.commit.__wrapped__


@pytest.fixture
def sources(monkeypatch, tmp_path) -> Path:
    """A copy of the project with one file in each package."""
    for package in ("bench", "methods", "sweeps"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "a.py").write_text("A = 1\n")
    monkeypatch.setattr(provenance, "ROOT", tmp_path)
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "bench" / "a.py"))
    return tmp_path


def test_code_from_elsewhere_is_known_by_its_file(tmp_path, monkeypatch):
    (tmp_path / "from_elsewhere.py").write_text("class Renderer:\n    A = 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    kind = importlib.import_module("from_elsewhere").Renderer
    before = provenance.foreign_digest(kind)
    (tmp_path / "from_elsewhere.py").write_text("class Renderer:\n    A = 2\n")
    assert None is not before != provenance.foreign_digest(kind)
    assert provenance.foreign_digest(Camera) is None


def test_the_digest_changes_with_every_source_that_can_change_a_row(sources):
    digests = [code_digest()]
    assert code_digest() == digests[0]
    (sources / "methods" / "a.py").write_text("A = 2\n")
    digests.append(code_digest())
    (sources / "bench" / "inner").mkdir()
    (sources / "bench" / "inner" / "b.py").write_text("")
    digests.append(code_digest())
    (sources / "bench" / "a.py").rename(sources / "bench" / "c.py")
    digests.append(code_digest())
    assert len(set(digests)) == len(digests)


def test_the_digest_does_not_change_with_anything_else(sources):
    before = code_digest()
    (sources / "sweeps" / "a.py").write_text("A = 2\n")
    (sources / "bench" / "notes.txt").write_text("notes")
    (sources / "bench" / "__pycache__").mkdir()
    (sources / "bench" / "__pycache__" / "a.pyc").write_bytes(b"\0")
    assert code_digest() == before


def git(folder: Path, *arguments: str) -> str:
    identity = ("-c", "user.name=test", "-c", "user.email=test@example.org")
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def test_a_checkout_names_its_commit_and_whether_it_was_changed(sources):
    git(sources, "init", "-q")
    git(sources, "add", ".")
    git(sources, "commit", "-q", "-m", "first")
    head = git(sources, "rev-parse", "--short=12", "HEAD")
    assert commit() == head
    (sources / "methods" / "a.py").write_text("A = 2\n")
    assert commit() == f"{head}-dirty"


def test_a_copy_installed_inside_another_repository_names_its_version(sources):
    git(sources, "init", "-q")
    git(sources, "add", "sweeps")
    git(sources, "commit", "-q", "-m", "a project that has steerbench in its .venv")
    assert commit() == metadata.version("steerbench")


def test_without_git_the_version_is_named(sources, monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert commit() == metadata.version("steerbench")


def test_the_machine_record_is_json_and_names_what_matters():
    record = json.loads(json.dumps(provenance.machine()))
    assert record["versions"]["torch"] == metadata.version("torch")
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
def test_processors_of_one_name_are_told_apart(text, name, monkeypatch):
    monkeypatch.setattr(Path, "read_text", lambda path, *more, **options: text)
    assert provenance.machine()["cpu"].endswith(name)


def test_an_engine_that_is_another_changes_figures_and_no_training(monkeypatch):
    before = [provenance.decisive(engines=engines) for engines in (False, True)]
    monkeypatch.setattr(provenance, "_version", lambda library: "another")
    after = [provenance.decisive(engines=engines) for engines in (False, True)]
    assert before[0] == after[0]
    assert before[1] != after[1]
