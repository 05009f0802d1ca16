"""The Python interface of steerbench: measure, train, score, and read results.

    import steerbench

    run = steerbench.run("method=ngp", "scene=totem", "budget=tiny")
    run.rows  # a DataFrame; in a notebook the run shows its tables

Settings are strings with the same meaning as in `steerbench run`. Errors are `SteerbenchError`s
with a message for the user.

| name | what it is for |
|---|---|
| `run` | measure a method on a scene, or read the result from the store |
| `fit` | train a method, or load it, to render any camera |
| `load_scene` | cameras, pictures and bounds of a scene |
| `score` | score pictures of any program against true ones |
| `results` | the rows of all runs in the store |
| `check` | whether the runs are as good as a recorded baseline, metric by metric |
| `methods`, `scenes` | what can be chosen, with a description of each |
| `Run` | what `run` and `score` return |
| `Method`, `Probe`, `NullProbe` | the interface of a method; the probe it reports to |
| `Scene`, `Split`, `Camera`, `Frame`, `Budget` | what methods take and return |
| `SteerbenchError` | base class of all errors that a user can fix |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd

from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from bench.results import existing_store
from bench.types import Budget, Camera, Frame, Method, NullProbe, Probe, Scene, Split
from reports.regression import Assertion
from reports.runs import Run, load_runs
from sweeps import configured
from sweeps.baseline import checked
from sweeps.measurement import Job, obtain
from sweeps.overrides import composed, described
from sweeps.scored import score
from sweeps.terminal import write_page

__all__ = [
    "Budget",
    "Camera",
    "Frame",
    "Method",
    "NullProbe",
    "Probe",
    "Run",
    "Scene",
    "Split",
    "SteerbenchError",
    "check",
    "fit",
    "load_scene",
    "methods",
    "results",
    "run",
    "scenes",
    "score",
]


def run(*settings: str) -> Run:
    """Measure what `settings` describe, unless the store has it already.

    Args:
        settings: as for `steerbench run`: "method=ngp", "scene=totem", "budget=tiny".
            `--config-dir=DIR` names a folder with further choices.
    """
    config = composed(settings)
    job = Job(config, ["steerbench", "run", *settings])
    (key,), _ = obtain([job])
    (run,) = load_runs(job.store, {key: key})
    label = str(run.facts["method"])
    write_page(config.report, job.store, {key: label})
    return replace(run, label=label)


def fit(*settings: str) -> Method:
    """Train the method that `settings` describe on its scene, or load its stored stages.

    `method.render(camera, NullProbe())` renders a camera in scene units; see `load_scene`.
    """
    config = composed(settings)
    return configured.trained(config, ConsoleLog(Path(config.outputs)))


def load_scene(*settings: str) -> Scene:
    """Load the scene of `settings`: "scene=blender", "scene.path=DIR"."""
    return configured.scene_of(composed(settings))


def results(outputs: str | Path = "outputs") -> pd.DataFrame:
    """All rows of all runs below `outputs`, one metric each; docs/protocol.md explains columns."""
    return existing_store(Path(outputs)).rows()


def check(baseline: str | Path, outputs: str | Path = "outputs") -> list[Assertion]:
    """Compare the runs below `outputs` with a file that `steerbench check --record` wrote.

    There is one for each run and metric of the baseline; its `verdict` is "worse", "missing" or "".
    """
    return [each for of_run in checked(Path(baseline), Path(outputs)) for each in of_run]


def methods(*settings: str) -> Mapping[str, str]:
    """The choices for `method=`, each with a description; `--config-dir=DIR` adds a folder's."""
    return described("method", settings)


def scenes(*settings: str) -> Mapping[str, str]:
    """The choices for `scene=`, in the same form as `methods`."""
    return described("scene", settings)
