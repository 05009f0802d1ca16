"""Runs as a page or a table needs them: all that the store knows of each, and what it is called."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import pandas as pd

from bench.errors import SteerbenchError
from bench.results import WHOLE, Store, unreadable
from reports.tables import headline, phases, suffix


@dataclass(frozen=True)
class Run:
    """One run of the store.

    Attributes:
        key: in the store.
        label: what it is called beside the others.
        rows: one metric per row.
        read_frames: gives `frames`; few reports look at single frames, which are most of a run.
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
        """The rows that speak for the run, one per metric: of steady frames, where it has any."""
        return headline(self.rows).set_index("metric")

    @cached_property
    def values(self) -> dict[str, float]:
        """Figures of the headline by metric."""
        return {str(metric): value for metric, value in self.headline["value"].items()}

    def phases(self) -> list[Run]:
        """The run once for each of its phases, each with the figures of that phase alone."""
        whole = self.rows[self.rows["phase"] == WHOLE]
        return [
            replace(self, label=self.label + suffix(phase), rows=pd.concat([of_phase, whole]))
            for phase, of_phase in phases(self.rows)
        ]

    @cached_property
    def facts(self) -> pd.Series:
        """What all rows of the run have in common: method, scene, protocol, device and so on."""
        return self.rows.iloc[0]

    @property
    def views(self) -> tuple[object, ...]:
        """The same for runs that rendered the same frames of the same scene."""
        where = (self.facts["split"], self.facts["trajectory"], self.facts["resolution"])
        return (self.record["scene"]["digest"], *where, len(self.frames))

    @property
    def conditions(self) -> tuple[object, ...]:
        """The same for runs whose figures may be held against each other."""
        phase = self.headline["phase"].iloc[0]
        return (*self.views, phase, self.facts["protocol"], *self.computer)

    @property
    def computer(self) -> tuple[str, ...]:
        """The same for runs on the same device of machines with the same processors."""
        machine = self.record["machine"]
        return (self.facts["device"], machine["cpu"], *machine["gpus"])


def load(store: Store, labels: Mapping[str, str]) -> list[Run]:
    """The runs whose keys `labels` has, in its order.

    Raises:
        SteerbenchError: one of them is not in the store, or of a schema that cannot be read.
    """
    records = {key: store.record(key) for key in labels}
    by_run = _rows_by_run(store)
    for key in labels:
        if key not in by_run:
            schema = records[key].get("schema_version")
            raise SteerbenchError(f"{store.folder / key}: {unreadable(schema)}")
    return [_run(store, key, label, by_run[key], records[key]) for key, label in labels.items()]


def readable(store: Store) -> list[Run]:
    """Every run that this version can read, under its key; the last that was stored comes last."""
    by_run = _rows_by_run(store)
    folders = [folder for folder in map(store.find, by_run) if folder]
    folders.sort(key=lambda folder: folder.stat().st_mtime)
    keys = [folder.name for folder in folders]
    return [_run(store, key, key, by_run[key], store.record(key)) for key in keys]


def _run(store: Store, key: str, label: str, rows: pd.DataFrame, record: Mapping[str, Any]) -> Run:
    frames = cache(partial(store.frames, key))
    return Run(key, label, rows, frames, record, store.folder / key / "pictures")


def _rows_by_run(store: Store) -> dict[str, pd.DataFrame]:
    """The rows of every run that can be read, and no word on the others."""
    rows = store.rows(report=lambda unreadable: None)
    return {str(run): of_run for run, of_run in rows.groupby("run")}
