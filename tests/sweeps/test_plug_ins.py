"""Methods and scenes from elsewhere: a folder beside a package, and packages from pip."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import MappingProxyType

import pytest

from bench import provenance
from sweeps.overrides import PLUG_INS, plug_ins

from .test_documents import WITHOUT_LPIPS, mine  # noqa: F401 (a fixture)

RENDERER = """
from mine.helper import LEVEL
from stand_ins import Grey


class Mine(Grey):
    name = "mine"

    def __init__(self):
        self.level = LEVEL
"""
SMALL = (
    *("scene=totem", "scene.width=16", "scene.train=2", "scene.test=2", "budget=tiny"),
    *("protocol.name=quick", "protocol.lpips=[]", "trajectory=test"),
)


@pytest.fixture
def folder(steerbench, tmp_path, monkeypatch) -> Path:
    """Of the package `mine` and the configuration of its method; all further calls find it."""
    package = tmp_path / "plug-in's/mine"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "helper.py").write_text("LEVEL = 0.5\n")
    (package / "renderer.py").write_text(RENDERER)
    config = package.parent / "configs/method/mine.yaml"
    config.parent.mkdir(parents=True)
    config.write_text("# Mine.\n_target_: mine.renderer.Mine\n")
    monkeypatch.syspath_prepend(package.parent)
    for name in [name for name in sys.modules if name.partition(".")[0] == "mine"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr("methods.checks.found", lambda name: [])
    return package.parent


@pytest.fixture
def call(steerbench, folder):
    return lambda command, *argv: steerbench(
        command, "--config-dir", str(folder / "configs"), *argv
    )


def test_a_change_in_a_module_is_a_new_run_of_a_new_process(call, folder, tmp_path):
    call("run", "method=mine", *SMALL).ok()
    assert call("run", "method=mine", *SMALL).err.startswith("already measured")
    for number, name in enumerate(("helper.py", "renderer.py"), 2):
        with (folder / "mine" / name).open("a") as file:
            file.write("CHANGED = 1\n")
        refused = call("run", "method=mine", *SMALL)
        assert f"mine/{name} was changed while this process runs" in refused.err
        provenance._loaded.cache_clear()  # as a new process
        for module in [each for each in sys.modules if each.partition(".")[0] == "mine"]:
            del sys.modules[module]
        assert call("run", "method=mine", *SMALL).status == 0
        assert len([*tmp_path.glob("outputs/runs/*/record.json")]) == number


def test_what_a_run_leaves_on_a_class_is_said_of_the_next_run_of_the_process(call, folder):
    with (folder / "mine" / "renderer.py").open("a") as file:
        file.write("    kept = {}\n\n    def reset(self):\n        self.kept[self.level] = 1\n")
    first = call("run", "method=mine", *SMALL).ok()
    assert "runs before it" not in first.err
    again = call("run", "method=mine", *SMALL, "store=always").ok()
    said = "runs before it in this process have changed mine.renderer.Mine.kept, which it may use"
    assert said in again.err
    assert said in call("run", "method=mine", *SMALL).err  # also of what is stored


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        *((f"{name} method=mien", "method 'mien'. Did you mean mine?")
          for name in ("run", "accuracy")),
        *((f"{name} --config-dir nowhere", "expected a folder, there is none at nowhere")
          for name in ("list", "report")),
        ("report --beside mein", "Did you mean mine?"),
        ("report --table table3 --beside mine", "table3 compares no methods; table1 does"),
    ],
)  # fmt: skip
def test_a_word_that_leads_nowhere_is_answered(call, argv, said):
    assert said in call(*argv.split()).refused()


# Packages from pip


def called(*words: str | Path, **more: str) -> str:
    done = subprocess.run(words, env=os.environ | more, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_the_package_of_the_document_is_installed_listed_and_measured(mine):  # noqa: F811
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
def plugged(tmp_path, monkeypatch) -> Iterator[Callable[..., Path | str]]:
    """Install a package `other` with an entry point of a value, and files of its folder."""
    monkeypatch.syspath_prepend(tmp_path / "site")

    def install(value, files=MappingProxyType({})):
        info = {
            "METADATA": "Metadata-Version: 2.1\nName: other\nVersion: 2.0\n",
            "entry_points.txt": f"[{PLUG_INS}]\nother = {value}\n",
        }
        there = {f"other-2.0.dist-info/{name}": text for name, text in info.items()}
        for name, text in (there | dict(files)).items():
            path = tmp_path / "site" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        plug_ins.cache_clear()
        (found,) = [one for name, one in plug_ins().items() if name.startswith("other")]
        return found

    yield install
    monkeypatch.undo()
    plug_ins.cache_clear()


def test_a_package_that_cannot_be_imported_or_is_not_there_is_a_line(plugged, steerbench):
    plugged("broken.configs", {"broken/__init__.py": "import nothing_of_this_name\n"})
    listed = steerbench("list").ok()
    assert "other (other 2.0)" in listed.out
    assert "No module named 'nothing_of_this_name'" in " ".join(listed.out.split())
    assert plugged("nowhere_at_all") == "there is no package nowhere_at_all"


def test_a_name_that_is_taken_stays_ours(plugged, steerbench):
    plugged("taken", {"taken/method/ngp.yaml": "# Theirs.\n_target_: theirs.Ngp\n"})
    listed = steerbench("list").out
    assert "Theirs." not in listed
    assert "method=ngp (hidden: the name is taken)" in " ".join(listed.split())
    refused = steerbench("run", "method=ngp", "scene=totem", "scene.width=no")
    assert "theirs" not in refused.err
