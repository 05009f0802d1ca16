"""Rows whose figures are known, several runs, and runs with other figures."""

import math
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from bench.results import COLUMNS, Store
from bench.sharing import write_sums
from reports.paper_tables import PaperTable, Place
from reports.runs import Repeated, Run, load_runs
from sweeps.tables import chosen
from tests.common import read_json, write_json

TABLES = {table.name: table for table in chosen()}
"""Those of the paper."""

FIGURES = {
    "psnr": (30.456, 29.5, 31.5),
    "ssim": (0.98765, 0.98, 0.99),
    "lpips_alex": (math.nan, math.nan, math.nan),
    "frame_ms": (200.0, 190.0, 210.0),
    "frame_ms.p50": (199.0, math.nan, math.nan),
    "frame_ms.p95": (220.0, math.nan, math.nan),
    "frame_ms.p99": (230.0, math.nan, math.nan),
    "fps": (5.0, 4.76, 5.26),
    "stage_ms.field": (150.0, 140.0, 160.0),
    "stage_ms.other": (50.0, 45.0, 55.0),
    "size_bytes.table": (25_000_000.0, math.nan, math.nan),
    "size_bytes.total": (25_200_000.0, math.nan, math.nan),
    "peak_bytes": (1e9, math.nan, math.nan),
    "train_s": (61.0, math.nan, math.nan),
}


@pytest.fixture
def rows() -> pd.DataFrame:
    table = pd.DataFrame.from_dict(FIGURES, "index", columns=["value", "lo", "hi"])
    table = (
        table.rename_axis("metric")
        .reset_index()
        .assign(run="0123456789abcdef", method="ngp", scene="totem", resolution="64x48", n=7)
    )
    whole = table["metric"].str.match("size_bytes|peak_bytes|train_s")
    table["phase"] = np.where(whole, "all", "steady")
    return table.reindex(columns=COLUMNS)


@pytest.fixture
def rows_with_cold(rows) -> pd.DataFrame:
    """The same of a method that looks back: two cold frames, 3 dB worse and half as fast."""
    cold = rows[rows["phase"] == "steady"].assign(phase="cold", n=2)
    figures = ["value", "lo", "hi"]
    cold.loc[cold["metric"] == "psnr", figures] -= 3
    cold.loc[cold["metric"].str.match("frame_ms|stage_ms"), figures] *= 2
    cold.loc[cold["metric"] == "fps", figures] /= 2
    return pd.concat([rows, cold], ignore_index=True)


def measured_of(table: PaperTable, runs: Mapping[str, Run]) -> dict[Place, Repeated]:
    """A run of each of these lines, by key, of the first block of `table`."""
    return {
        Place(table.name, table.data_sets[0], key): Repeated(table.lines[key].label, [run])
        for key, run in runs.items()
    }


def run_of(rows: pd.DataFrame, label: str = "run", **record: object) -> Run:
    """A run that has nothing but `rows` and a `record`."""
    known = {"made_of": {}, "command": "", **record}
    return Run(label, label, rows, lambda: pd.DataFrame(columns=["frame", "phase"]), known, Path())


def changed(run: Run, figures: Mapping[str, float], **facts: object) -> Run:
    """`run` with other `figures`, by metric, and other `facts` in all rows."""
    rows = run.rows.assign(**facts)
    value = rows["value"].mask(rows["metric"].isin(figures), rows["metric"].map(figures))
    return replace(run, rows=rows.assign(value=value))


def elsewhere(run: Run) -> Run:
    machine = {**run.record["machine"], "cpu": "another"}
    return replace(run, record={**run.record, "machine": machine})


def shifted(run: Run, by: float | list[float], **facts: object) -> Run:
    """`run` with a PSNR larger by so much, in the mean and `by` frame, and other `facts`."""
    frames = run.frames.assign(psnr=run.frames["psnr"] + by)
    moved = changed(run, {"psnr": run.values["psnr"] + np.mean(by)}, **facts)
    return replace(moved, read_frames=lambda: frames)


def of_scene(run: Run, scene: str, by: float = 0.0, **facts: object) -> Run:
    """`run` as that of another scene, with a PSNR larger by so much."""
    other = shifted(run, by, scene=scene, **facts)
    record = {**run.record, "scene": {**run.record["scene"], "digest": scene}}
    return replace(other, key=f"{run.key}-{scene}", record=record)


@pytest.fixture
def run(store, stored_run) -> Run:
    """A run of six scored frames, three of them pictured."""
    (found,) = load_runs(store, [stored_run])
    return found


@pytest.fixture
def drawn(monkeypatch) -> list[Figure]:
    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


def rewrite(store: Store, key: str, **others: object) -> None:
    """Change the record of a stored run; `machine` and `scene` are changed in part."""
    path = store.folder / key / "record.json"
    record = read_json(path)
    for name, value in others.items():
        record[name] = {**record.get(name, {}), **value} if isinstance(value, dict) else value
    write_json(path, record)
    write_sums(path.parent)


def copied(store: Store, source: str, key: str) -> Path:
    """The folder of a copy of the run `source`, stored as `key`."""
    folder = shutil.copytree(store.folder / source, store.folder / key)
    for file in (folder / "rows.csv", folder / "record.json"):
        file.write_text(file.read_text().replace(source, key))
    write_sums(folder)
    return folder


def rename(store: Store, key: str, method: str) -> None:
    path = store.folder / key / "rows.csv"
    pd.read_csv(path).assign(method=method).to_csv(path, index=False)
    rewrite(store, key, command="steerbench run seed=5")


@pytest.fixture
def several(store, stored_run) -> tuple[Store, dict[str, str]]:
    """A store with six runs of the same frames, and the method of each.

    The last was made on another machine; all else is the same.
    """
    labels = {stored_run: "first"}
    rename(store, stored_run, "first")
    for number in range(5):
        key = f"{number}{stored_run[1:]}"
        copied(store, stored_run, key)
        labels[key] = f"copy {number}"
        rename(store, key, labels[key])
    rewrite(store, key, machine={"cpu": "another"})
    rows = store.folder / stored_run / "rows.csv"
    table = pd.read_csv(rows)
    table.loc[table["metric"] == "psnr", "value"] += 1  # the best
    table.to_csv(rows, index=False)
    write_sums(rows.parent)
    return store, labels
