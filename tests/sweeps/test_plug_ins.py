"""Packages from pip bring methods and scenes of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import pytest

from sweeps import plug_ins

from .test_documents import WITHOUT_LPIPS, mine  # noqa: F401 (a fixture)


def called(*words: str | Path, **more: str) -> str:
    done = subprocess.run(words, env=os.environ | more, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_package_of_the_document_is_installed_listed_and_measured(mine: Path) -> None:  # noqa: F811
    bin_ = Path(sys.executable).parent
    offline = ("--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--target", "site")
    called(sys.executable, "-m", "pip", "install", *offline, ".")
    for name in ("mean_colour", "configs", "npz.py"):  # only what was installed is there
        path = mine / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    listed = called(bin_ / "steerbench", "list", PYTHONPATH="site", COLUMNS="200")
    assert "mean_colour (mean-colour 1.0)" in listed
    assert "method=mean_colour, scene=npz" in listed
    words = ("method=mean_colour", "scene=npz", "scene.path=views.npz", *WITHOUT_LPIPS)
    assert "19.83" in called(bin_ / "steerbench", "run", *words, PYTHONPATH="site")


@pytest.fixture
def plugged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., plug_ins.PlugIn]]:
    """Install a package `other` with an entry point of a value, and files of its folder."""
    monkeypatch.syspath_prepend(tmp_path / "site")

    def install(value: str, files: Mapping[str, str] = MappingProxyType({})) -> plug_ins.PlugIn:
        info = {
            "METADATA": "Metadata-Version: 2.1\nName: other\nVersion: 2.0\n",
            "entry_points.txt": f"[{plug_ins.GROUP}]\nother = {value}\n",
        }
        there = {f"other-2.0.dist-info/{name}": text for name, text in info.items()}
        for name, text in (there | dict(files)).items():
            path = tmp_path / "site" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        plug_ins.installed.cache_clear()
        (found,) = [one for one in plug_ins.installed() if one.name.startswith("other")]
        return found

    yield install
    monkeypatch.undo()
    plug_ins.installed.cache_clear()


def test_a_package_that_cannot_be_imported_is_a_line(plugged, steerbench):
    plugged("broken.configs", {"broken/__init__.py": "import nothing_of_this_name\n"})
    listed = steerbench("list")
    assert listed.status == 0
    assert "other (other 2.0)" in listed.out
    assert "No module named 'nothing_of_this_name'" in " ".join(listed.out.split())


def test_an_entry_that_leads_nowhere_says_so(plugged):
    found = plugged("nowhere_at_all")
    assert found.folder is None
    assert found.fault == "there is no package nowhere_at_all"


def test_a_name_that_is_taken_stays_ours(plugged, steerbench):
    plugged("taken", {"taken/method/ngp.yaml": "# Theirs.\n_target_: theirs.Ngp\n"})
    listed = steerbench("list").out
    assert "Theirs." not in listed
    assert "method=ngp (hidden: the name is taken)" in " ".join(listed.split())
    refused = steerbench("run", "method=ngp", "scene=totem", "scene.width=no")
    assert "theirs" not in refused.err
