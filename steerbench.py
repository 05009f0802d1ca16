"""steerbench from Python: measure, train, score, and read what was measured.

    import steerbench

    run = steerbench.run("method=ngp", "scene=totem", "budget=tiny")
    run.rows  # a DataFrame; in a notebook the run shows its tables

Settings are the words of `steerbench run`, and mean the same. What raises, raises
`SteerbenchError` with a message for the user.

| name | what it is for |
|---|---|
| `run` | measure a method on a scene, or read that from the store |
| `fit` | the trained method itself, to render any camera |
| `load_scene` | cameras, pictures and bounds of a scene |
| `score` | pictures of any program against true ones |
| `results` | the rows of all runs in the store |
| `methods`, `scenes` | what can be chosen, with a line on each |
| `Run` | what `run` and `score` return |
| `Method`, `Probe`, `NullProbe` | what a method must have; what it reports to |
| `Scene`, `Split`, `Camera`, `Frame`, `Budget` | what methods are given and return |
| `SteerbenchError` | base of all errors a user can mend |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pandas as pd

import sweeps  # noqa: F401 (first: it sets what torch reads when it is loaded)
from bench.console import ConsoleLog
from bench.pictures import Match
from bench.results import Store
from bench.types import (
    Budget,
    Camera,
    Frame,
    Method,
    NullProbe,
    Probe,
    Scene,
    Split,
    SteerbenchError,
)
from reports.runs import Run, load
from sweeps import configured, measurement
from sweeps.catalogue import described
from sweeps.overrides import composed
from sweeps.score import scored

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
        settings: the words of `steerbench run`: "method=ngp", "scene=totem", "budget=tiny".
            `--config-dir=DIR` names a folder with further choices.

    Raises:
        SteerbenchError: a setting is wrong, or something in the measurement went wrong.
    """
    obtained = measurement.obtain(composed(settings), ["steerbench", "run", *settings])
    (found,) = load(obtained.store, {obtained.run: obtained.run})
    return replace(found, label=str(found.facts["method"]))


def fit(*settings: str) -> Method:
    """The method that `settings` describe, trained on its scene, or loaded from its stored stages.

    `method.render(camera, NullProbe())` renders a camera in scene units; see `load_scene`.

    Raises:
        SteerbenchError: a setting is wrong, or something in the training went wrong.
    """
    config = composed(settings)
    return configured.trained(config, ConsoleLog(Path(config.outputs)))


def load_scene(*settings: str) -> Scene:
    """The scene of `settings`: "scene=blender", "scene.path=DIR".

    Raises:
        SteerbenchError: it cannot be loaded.
    """
    return configured.scene_of(composed(settings))


def score(
    pictures: str | Path,
    truth: str | Path | None = None,
    *settings: str,
    name: str | None = None,
    match: Match = "name",
    sequence: bool = False,
) -> Run:
    """Score a folder of pictures against true ones, as `steerbench score` does.

    Args:
        truth: the folder of the true ones; None: the split of the scene in `settings`.
        name: of the method in the rows; None: that of the folder.
        match: how a picture finds its truth.
        sequence: whether the pictures follow one another: the flicker is scored, too.

    Raises:
        SteerbenchError: pictures are missing, damaged or of another size.
    """
    return scored(
        Path(pictures),
        None if truth is None else Path(truth),
        settings,
        name=name,
        match=match,
        sequence=sequence,
    )


def results(outputs: str | Path = "outputs") -> pd.DataFrame:
    """One metric per row, of all runs below `outputs`; docs/protocol.md explains the columns."""
    return Store(Path(outputs)).rows()


def methods(*settings: str) -> Mapping[str, str]:
    """What can follow `method=`, and what each is; `--config-dir=DIR` adds those of a folder."""
    return described("method", settings)


def scenes(*settings: str) -> Mapping[str, str]:
    """The same of `scene=`."""
    return described("scene", settings)
