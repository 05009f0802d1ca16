"""What `pip install` of the wheel gives, in an environment and a folder outside the checkout."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.common import ROOT
from tests.sweeps.test_documents import write_files
from tests.test_project import PACKAGES

METADATA = ("pyproject.toml", "README.md", "LICENSE")
TINY = (
    *("budget=tiny", "budget.steps=2", "budget.renderer_steps=2", "budget.frames=2"),
    *("scene.width=48", "scene.train=4", "scene.test=4", "protocol.lpips=[]", "protocol.name=tiny"),
)


@pytest.mark.parametrize(
    ("found", "file"), [("bench", "bench/__init__.py"), ("bench.py", "bench.py")]
)
def test_a_foreign_package_of_the_same_name_is_named_in_one_line(tmp_path, found, file):
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).touch()
    ran = subprocess.run(
        [sys.executable, "-c", "import sweeps"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
    )
    (said,) = ran.stderr.splitlines()
    assert ran.returncode == 1
    assert said.startswith(f"steerbench: expected Python to find its package 'bench' in {ROOT}")
    assert f"it finds {tmp_path / found}: rename" in said


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """The `steerbench` of an environment that has the wheel, and the libraries of this one."""
    source, folder = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    environment = folder / "environment"
    for name in PACKAGES:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in (*ROOT.glob("*.py"), *map(ROOT.joinpath, METADATA)):
        shutil.copy(path, source)
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    alone = ["--no-deps", "--no-index"]
    built = [*pip, "wheel", *alone, "--no-build-isolation", "-w", str(folder), str(source)]
    subprocess.run(built, check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", environment], check=True)
    (wheel,) = folder.glob("*.whl")
    there = ["--python", str(environment / "bin/python")]
    subprocess.run([*pip, *there, "install", *alone, str(wheel)], check=True)
    (libraries,) = environment.glob("lib/python*/site-packages")
    (libraries / "libraries.pth").write_text(sysconfig.get_path("purelib"))
    return environment / "bin/steerbench"


@pytest.fixture
def steerbench(installed, tmp_path):
    """Call it in an empty folder; what it printed."""
    elsewhere = {name: x for name, x in os.environ.items() if name != "PYTHONPATH"}

    def call(*words, **more):
        given = {"cwd": tmp_path, "env": elsewhere | more, "text": True, "timeout": 900}
        ran = subprocess.run([installed, *words], capture_output=True, **given)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    return call


@pytest.mark.slow
def test_the_wheel_runs_a_plug_in_and_a_worker(steerbench, tmp_path):
    """Those of the documents: the class in this process, the program in another."""
    write_files("extending.md", tmp_path)
    write_files("external.md", tmp_path)
    listed = steerbench("list", "--config-dir", "configs", PYTHONPATH=".")
    assert "The mean colour of the training pictures." in listed
    own = ("run", "--config-dir", "configs", "scene=totem", *TINY)
    assert "paint" in steerbench(*own, "method=mean_colour", PYTHONPATH=".")
    shutil.copy(ROOT / "steerbench_worker.py", tmp_path)
    assert "PSNR" in steerbench(*own, "method=external", "method.command=mean_worker.py")
