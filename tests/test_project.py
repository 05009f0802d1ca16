"""The project's own files agree with each other and with what is installed."""

import ast
import os
import re
import subprocess
import tomllib
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from bench import provenance
from sweeps.overrides import CONFIGS, composed

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = ("bench", "methods", "reports", "sweeps")
EXTRAS = PYPROJECT["project"]["optional-dependencies"]


def pins() -> dict[str, str]:
    """Version by name, of every line of constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    exact = [line for line in lines if line and not line.startswith("#")]
    return dict(re.fullmatch(r"([a-z0-9-]+)==([\w.]+)", line).groups() for line in exact)


def closure(requirements: list[str]) -> Iterator[Requirement]:
    """The requirements, and those of whatever is installed for them."""
    seen, pending = set(), [Requirement(text) for text in requirements]
    while pending:
        requirement = pending.pop()
        yield requirement
        for extra in ("", *requirement.extras):
            name = (canonicalize_name(requirement.name), extra)
            if name not in seen:
                seen.add(name)
                needed = map(Requirement, metadata.requires(requirement.name) or [])
                pending += [
                    other
                    for other in needed
                    if not other.marker or other.marker.evaluate({"extra": extra})
                ]


MOST_NODES = {"product": 276_800, "tests": 182_700}
"""Nodes of the syntax tree without docstrings, so that lines are free: lower these."""


def nodes(path: Path) -> int:
    every = ast.walk(ast.parse(path.read_text()))
    return sum(not provenance._is_text(node) for node in every)


def test_there_is_no_more_code_than_there_was():
    product = [path for top in PACKAGES for path in (ROOT / top).rglob("*.py")]
    product += [ROOT / "steerbench.py", ROOT / "steerbench_worker.py"]
    files = {"product": product, "tests": (ROOT / "tests").rglob("*.py")}
    for part, of in files.items():
        assert sum(map(nodes, of)) <= MOST_NODES[part], part


def test_every_file_beside_the_sources_is_shipped():
    of_package = PYPROJECT["tool"]["setuptools"]["package-data"]
    folders = {name: ROOT / name.replace(".", os.sep) for name in of_package}
    shipped = {
        path for name, patterns in of_package.items() for of in patterns
        for path in folders[name].glob(of)
    }  # fmt: skip
    files = (path for top in PACKAGES for path in (ROOT / top).rglob("*.*"))
    found = {path for path in files if path.suffix != ".py" and "__pycache__" not in path.parts}
    assert shipped == found


def test_everything_that_is_installed_for_the_project_is_pinned():
    requirements = [*PYPROJECT["project"]["dependencies"], *EXTRAS["dev"]]
    needed = {canonicalize_name(requirement.name) for requirement in closure(requirements)}
    # A torch with CUDA itself pins the libraries that it was built with.
    of_torch = {name for name in needed if name.startswith(("cuda-", "nvidia-"))}
    assert needed - of_torch - pins().keys() == set()


def test_every_pin_suits_the_range_in_pyproject():
    texts = [*PYPROJECT["project"]["dependencies"]]
    texts += [text for wanted in EXTRAS.values() for text in wanted]
    for requirement in map(Requirement, texts):
        version = pins()[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), f"{requirement}: pinned to {version}"


def test_the_changelog_and_the_citation_are_of_the_current_version():
    version = PYPROJECT["project"]["version"]
    assert f"## {version}" in (ROOT / "CHANGELOG.md").read_text()
    citation = OmegaConf.load(ROOT / "CITATION.cff")
    assert (citation.version, citation.license) == (version, "MIT")
    assert "2212.08476" in (ROOT / "CITATION.cff").read_text()


def test_make_explains_which_python_it_needs(tmp_path):
    command = ["make", "install", f"VENV={tmp_path / 'venv'}", "PYTHON=no-such-python"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "needs Python 3.11 or newer" in done.stderr
    assert "no-such-python" in done.stderr


def test_what_the_readme_makes_is_a_target():
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    typed = re.findall(r"^make ([a-z]+)", (ROOT / "README.md").read_text(), re.MULTILINE)
    assert {"demo", *typed} <= set(targets)


@pytest.mark.parametrize("name", [path.stem for path in (CONFIGS / "experiment").glob("*.yaml")])
def test_every_experiment_and_all_jobs_of_its_sweep_compose(name):
    experiment = f"+experiment={name}"
    params = composed([experiment], return_hydra_config=True).hydra.sweeper.params or {}
    settings = [[f"{key}={value}" for value in values.split(",")] for key, values in params.items()]
    # Whether a setting exists depends on the choices, not on values: each beside the first others.
    first = [values[0] for values in settings]
    jobs = {
        (*first[:place], value, *first[place + 1 :])
        for place, values in enumerate(settings)
        for value in values
    } or {()}
    assert jobs  # of a study, whose lines methods declare, the one that is as its file says
    assert all(composed([experiment, *job]).method for job in jobs)
