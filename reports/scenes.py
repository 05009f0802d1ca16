"""Computes means over scenes, and the table of the individual scenes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import pandas as pd

from bench.results import content_key
from reports.comparison import metric_format, written
from reports.runs import Repeated, Run
from reports.tables import NOT_AVAILABLE, Table

FIGURES = ("metric", "unit", "phase", "value", "n", "lo", "hi")
"""The columns of rows that are not facts about the whole run."""

PARTS = ("stage_ms.", "work.")
"""Prefixes of metrics that a run lacks if the stage or the work did not occur in it."""


def over_scenes(runs: Sequence[Run]) -> Run:
    """Average runs of different scenes into one run.

    Its rows are means of their headline rows, for the metrics that all of them have; its frames are
    the frames of all. A stage or counter that a run lacks counts as 0 for it.
    """
    if len(runs) == 1:
        return runs[0]
    scenes = [str(run.facts["scene"]) for run in runs]
    found = pd.concat([run.headline.reset_index() for run in runs])
    of_metric = found.groupby("metric", sort=False)
    complete = of_metric["value"].transform("size") == len(runs)
    found = found[complete | found["metric"].str.startswith(PARTS)]
    of_metric = found.groupby("metric", sort=False)
    rows = of_metric[["unit", "phase"]].first().reset_index()
    totals = of_metric["value"].agg(lambda values: values.sum(skipna=False))
    rows["value"] = totals.to_numpy() / len(runs)
    rows["n"] = of_metric["n"].sum().to_numpy()
    names = [name for name in map(str, runs[0].rows) if name not in FIGURES]
    facts = {name: _joined([run.facts[name] for run in runs]) for name in names}
    facts["scene"] = f"mean of {', '.join(scenes)}"
    key = facts["run"] = content_key({"mean of": [run.key for run in runs]})[:16]
    rows = rows.assign(lo=math.nan, hi=math.nan, **facts)
    read_frames = partial(_frames, dict(zip(scenes, runs, strict=True)))
    return Run(key, runs[0].label, rows, read_frames, _record(runs), runs[0].pictures)


def scene_table(metrics: Sequence[str], lines: Sequence[Repeated]) -> Table:
    """A table of individual scenes: means of `metrics` over seeds, one line per scene and line."""
    scenes = dict.fromkeys(sorted(scene for line in lines for scene in line.by_scene))
    shown = [
        (f"{scene}: {line.label}", Repeated(line.label, line.by_scene[scene]))
        for scene in scenes
        for line in lines
        if scene in line.by_scene
    ]
    cells = tuple(
        (name, *(written(of_scene, metric) or NOT_AVAILABLE for metric in metrics))
        for name, of_scene in shown
    )
    heads = ("measured", *(metric_format(metric)[0] for metric in metrics))
    return Table("Each scene", heads, cells, sources=tuple(of_scene.keys for _, of_scene in shown))


def _frames(by_scene: Mapping[str, Run]) -> pd.DataFrame:
    """The frames of all scenes, with the scene's name added to their names."""
    return pd.concat(
        [
            run.frames.assign(name=f"{scene}/" + run.frames["name"].fillna(""))
            for scene, run in by_scene.items()
        ],
        ignore_index=True,
    )


def _record(runs: Sequence[Run]) -> dict[str, Any]:
    """The record of the first run, with the scenes, machines and missing figures of all."""
    records = [run.record for run in runs]
    machines = [record["machine"] for record in records]
    machine = {name: _joined([of[name] for of in machines]) for name in ("cpu", "threads")}
    gpus = list(dict.fromkeys(gpu for of in machines for gpu in of["gpus"]))
    digest = content_key({"mean of": [record["scene"]["digest"] for record in records]})
    return {
        **records[0],
        "machine": {**machines[0], **machine, "gpus": gpus},
        "scene": {**records[0]["scene"], "digest": digest},
        "missing": {name: why for record in records for name, why in record["missing"].items()},
    }


def _joined(values: Sequence[Any]) -> Any:
    """The value if all are equal, otherwise all of them as text."""
    distinct = list(dict.fromkeys(values))
    return distinct[0] if len(distinct) == 1 else " / ".join(map(str, distinct))
