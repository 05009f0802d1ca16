"""Runs of the store, with everything that tables and pages need from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from bench.errors import SteerbenchError
from bench.intervals import half_interval
from bench.results import STEADY, WHOLE, Store, unreadable
from bench.run import phase_rows
from reports.tables import headline, phases, run_tables, suffix


@dataclass(frozen=True)
class Run:
    """One run of the store.

    Attributes:
        key: its key in the store.
        label: its name in a table or figure.
        rows: one metric per row.
        read_frames: reads `frames` on demand: few reports need them, and they are most of a run.
        record: what the figures mean, and where they come from.
        pictures: folder of ground truths, renderings and error maps.
    """

    key: str
    label: str
    rows: pd.DataFrame
    read_frames: Callable[[], pd.DataFrame]
    record: Mapping[str, Any]
    pictures: Path

    @property
    def frames(self) -> pd.DataFrame:
        """One frame per row."""
        return self.read_frames()

    @cached_property
    def headline(self) -> pd.DataFrame:
        """One row per metric, for the steady frames, or the cold ones if there are no others."""
        return headline(self.rows).set_index("metric")

    @cached_property
    def values(self) -> dict[str, float]:
        """Figures of the headline by metric."""
        return {str(metric): value for metric, value in self.headline["value"].items()}

    def phases(self) -> list[Run]:
        """The run once per phase, with only the figures of that phase."""
        whole = self.rows[self.rows["phase"] == WHOLE]
        return [
            replace(self, label=self.label + suffix(phase), rows=pd.concat([of_phase, whole]))
            for phase, of_phase in phases(self.rows)
        ]

    def _repr_markdown_(self) -> str:
        """The run's tables, for display in a notebook."""
        tables = "\n\n".join(f"#### {x.title}\n\n{x.markdown()}" for x in run_tables(self.rows))
        return f"### {self.label}\n\n{tables}"

    @cached_property
    def facts(self) -> pd.Series:
        """The columns that are equal in all rows: method, scene, protocol, device and so on."""
        return self.rows.iloc[0]

    @property
    def views(self) -> tuple[object, ...]:
        """Equal for runs that rendered the same frames of the same scene."""
        where = (self.facts["split"], self.facts["trajectory"], self.facts["resolution"])
        return (self.record["scene"]["digest"], *where, len(self.frames))

    @property
    def computer(self) -> tuple[str, ...]:
        """Equal for runs on the same device and the same kind of processor."""
        machine = self.record["machine"]
        return (self.facts["device"], machine["cpu"], *machine["gpus"])

    @property
    def conditions(self) -> tuple[object, ...]:
        """Equal for runs whose figures are comparable."""
        phase = self.headline["phase"].iloc[0]
        return (*self.views, phase, self.facts["protocol"], *self.computer)


@dataclass(frozen=True)
class Repeated:
    """Runs that differ only in their seed. Figures are means over them.

    Attributes:
        label: name of the table line that they fill.
        runs: one for each measured seed; for a data set, each is a mean over scenes.
        gaps: why other runs are missing.
        by_scene: for a data set, all measured runs by scene; first the scenes in the means.
    """

    label: str
    runs: Sequence[Run]
    gaps: Sequence[str] = ()
    by_scene: Mapping[str, Sequence[Run]] = field(default_factory=dict)

    @property
    def measured(self) -> list[Run]:
        """The stored runs behind the figures, each of a single scene."""
        return [run for runs in self.by_scene.values() for run in runs] or list(self.runs)

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of the stored runs behind the figures."""
        return tuple(run.key for run in self.measured)

    @cached_property
    def values(self) -> dict[str, float]:
        """Means by metric, for the metrics that all runs have."""
        if not self.runs:
            return {}
        tables = [run.values for run in self.runs]
        names = [name for name in tables[0] if all(name in table for table in tables)]
        return {name: float(np.mean([table[name] for table in tables])) for name in names}

    @property
    def conditions(self) -> tuple[object, ...]:
        """See `Run.conditions`."""
        return self.runs[0].conditions if self.runs else ()

    def mean(self, metric: str) -> float | None:
        """The mean of a metric; a stage includes its nested stages. None without figures."""
        figures = self._figures(metric)
        return float(np.mean(figures)) if figures else None

    def half(self, metric: str) -> float:
        """Half the 95 % interval of this mean; nan with fewer than two seeds."""
        return half_interval(np.array(self._figures(metric)))

    def _figures(self, metric: str) -> list[float]:
        """The metric of every run that has it; a stage includes its nested stages."""
        of_runs = (
            [
                value
                for name, value in run.values.items()
                if name == metric or name.startswith(f"{metric}/")
            ]
            for run in self.runs
        )
        return [math.fsum(figures) for figures in of_runs if figures]


def over_common_frames(runs: Sequence[Run]) -> list[Run]:
    """The same runs, with steady figures recomputed over the frames that are steady in all of them.

    "All" means the runs that render the same views. A method with memory has fewer steady ones, and
    the first frames of a path are not typical, so that means over different frames would mislead.

    Runs without steady frames stay unchanged, and so do runs without any common steady frame.
    """
    steady = [set(run.frames.loc[run.frames["phase"] == STEADY, "frame"]) for run in runs]
    common: dict[tuple[object, ...], set[int]] = {}
    for run, frames in zip(runs, steady, strict=True):
        if frames:
            common[run.views] = common.get(run.views, frames) & frames
    return [
        _over(run, kept) if (kept := common.get(run.views, frames)) and kept < frames else run
        for run, frames in zip(runs, steady, strict=True)
    ]


def _over(run: Run, kept: Collection[int]) -> Run:
    """The run with steady figures computed over the frames `kept`."""
    frames = run.frames
    chosen = frames[(frames["phase"] == STEADY) & frames["frame"].isin(kept)]
    found = pd.DataFrame(phase_rows(chosen)).set_index("metric")
    rows = run.rows.copy()
    changed = (rows["phase"] == STEADY) & rows["metric"].isin(found.index)
    for column in ("value", "n", "lo", "hi"):
        rows.loc[changed, column] = rows.loc[changed, "metric"].map(found[column])
    return replace(run, rows=rows)


def load(store: Store, labels: Mapping[str, str]) -> list[Run]:
    """Load the runs whose keys are in `labels`, in its order.

    Raises:
        SteerbenchError: a run is not in the store, or has a schema that cannot be read.
    """
    records = {key: store.record(key) for key in labels}
    by_run = _rows_by_run(store, labels)
    for key in labels:
        if key not in by_run:
            schema = records[key].get("schema_version")
            raise SteerbenchError(f"{store.folder / key}: {unreadable(schema)}")
    return [_run(store, key, label, by_run[key], records[key]) for key, label in labels.items()]


def readable(store: Store) -> list[Run]:
    """Every run that this version can read, labelled with its key, in the order of storing."""
    by_run = _rows_by_run(store)
    folders = [folder for folder in map(store.find, by_run) if folder]
    folders.sort(key=lambda folder: folder.stat().st_mtime)
    keys = [folder.name for folder in folders]
    return [_run(store, key, key, by_run[key], store.record(key)) for key in keys]


def _run(store: Store, key: str, label: str, rows: pd.DataFrame, record: Mapping[str, Any]) -> Run:
    frames = cache(partial(store.frames, key))
    return Run(key, label, rows, frames, record, store.folder / key / "pictures")


def _rows_by_run(store: Store, keys: Collection[str] | None = None) -> dict[str, pd.DataFrame]:
    """The rows of every readable run, or only of those in `keys`, without a word of others."""
    rows = store.rows(report=lambda unreadable: None, keys=keys)
    return {str(run): of_run for run, of_run in rows.groupby("run")}
