"""The Python interface of steerbench: measure, train, score, and read results.

    import steerbench

    run = steerbench.run("method=ngp", "scene=totem", "budget=tiny")
    run.rows  # a DataFrame; in a notebook the run shows its tables

Settings are strings with the same meaning as in `steerbench run`. Errors are `SteerbenchError`s
with a message for the user. Environment, `sys.argv`, random numbers and threads are left as found.

| name | what it is for |
|---|---|
| `run` | measure a method on a scene, or read the result from the store |
| `sweep` | measure every combination of settings; returns its runs and its table |
| `load` | a run of the store, by its key |
| `fit` | train a method, or load it, to render any camera |
| `load_scene` | cameras, pictures and bounds of a scene |
| `score` | score pictures of any program against true ones |
| `results` | the rows of all runs in the store |
| `check` | whether the runs are as good as a recorded baseline, metric by metric |
| `methods`, `scenes` | what can be chosen, with a description of each |
| `Run`, `Sweep` | what `run`, `load` and `score` return; what `sweep` returns |
| `Method`, `Probe`, `NullProbe` | the interface of a method; the probe it reports to |
| `Scene`, `Split`, `Camera`, `Frame`, `Budget` | what methods take and return |
| `SteerbenchError` | base class of all errors that a user can fix |
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pandas as pd

from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from bench.isolation import as_begun
from bench.results import existing_store
from bench.types import Budget, Camera, Frame, Method, NullProbe, Probe, Scene, Split
from reports.comparison import columns_of
from reports.lines import as_lines
from reports.lines import results as rows_of
from reports.regression import Assertion
from reports.runs import Run, load_runs
from sweeps import configured
from sweeps.baseline import checked
from sweeps.commands.score import score
from sweeps.hydra_runs import run_hydra
from sweeps.measurement import Job, obtain
from sweeps.overrides import composed, described
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
    "Sweep",
    "check",
    "fit",
    "load",
    "load_scene",
    "methods",
    "results",
    "run",
    "scenes",
    "score",
    "sweep",
]


@as_begun()
def run(*settings: str) -> Run:
    """Measure what `settings` describe, unless the store has it already.

    Args:
        settings: as for `steerbench run`: "method=ngp", "scene=totem", "budget=tiny".
            `--config-dir=DIR` names a folder with further choices.
    """
    config = composed(settings)
    job = Job(config, ["steerbench", "run", *settings])
    (key,), _ = obtain([job])
    write_page(config.report, job.store, [key])
    return load_runs(job.store, [key])[0]


class Sweep(NamedTuple):
    """The `runs` of a sweep, and its `table`, a line for all runs that differ only in their seed.

    A line has its settings, the number of seeds and, of each metric, the mean and half the 95 %
    interval of this mean ("psnr", "psnr.half").
    """

    runs: Sequence[Run]
    table: pd.DataFrame


@as_begun()
def sweep(*settings: str) -> Sweep:
    """Measure every combination of `settings`, of which any may have several values: "seed=0,1,2".

    What the store has is not measured again. If jobs fail, the others are still measured; then the
    first error is raised.
    """
    ended, errors = run_hydra(["-m", *settings], alone=lambda config, command: None)
    if errors:
        raise errors[0]
    keys = dict.fromkeys(end.run for _, end in ended if end.run)
    lines = as_lines(load_runs(ended[0][0].store, keys))
    return Sweep(lines.runs, lines.frame(columns_of(lines)))


def load(key: str, outputs: str | Path = "outputs") -> Run:
    """The run of the store below `outputs` whose key begins with `key`."""
    store = existing_store(Path(outputs))
    return load_runs(store, [store.whole_key(key)])[0]


@as_begun()
def fit(*settings: str) -> Method:
    """Train the method that `settings` describe on its scene, or load its stored stages.

    `method.render(camera, NullProbe())` renders a camera in scene units; see `load_scene`.
    """
    config = composed(settings)
    method = configured.trained(config, ConsoleLog(Path(config.outputs)))
    configured.forget_scene()  # whose pictures the method has from now on
    return method


@as_begun()
def load_scene(*settings: str) -> Scene:
    """Load the scene of `settings`: "scene=blender", "scene.path=DIR"."""
    scene = configured.scene_of(composed(settings))
    configured.forget_scene()  # it is the user's from now on, who may write to it
    return scene


def results(outputs: str | Path = "outputs") -> pd.DataFrame:
    """All rows of all runs below `outputs`, one metric each, with the settings that differ.

    docs/protocol.md explains the columns.
    """
    return rows_of(existing_store(Path(outputs)), ConsoleLog(Path(outputs)).info)


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
