"""Rows whose figures are known, and several runs."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from bench.results import COLUMNS, Store
from reports.runs import Run, load

FIGURES = {
    "psnr": (30.456, 29.5, 31.5),
    "ssim": (0.98765, 0.98, 0.99),
    "lpips_alex": (float("nan"),) * 3,
    "frame_ms": (200.0, 190.0, 210.0),
    "frame_ms.p50": (199.0, float("nan"), float("nan")),
    "frame_ms.p95": (220.0, float("nan"), float("nan")),
    "frame_ms.p99": (230.0, float("nan"), float("nan")),
    "fps": (5.0, 4.76, 5.26),
    "stage_ms.field": (150.0, 140.0, 160.0),
    "stage_ms.other": (50.0, 45.0, 55.0),
    "size_bytes.table": (25_000_000.0, float("nan"), float("nan")),
    "size_bytes.total": (25_200_000.0, float("nan"), float("nan")),
    "peak_bytes": (1e9, float("nan"), float("nan")),
    "train_s": (61.0, float("nan"), float("nan")),
}


@pytest.fixture
def rows() -> pd.DataFrame:
    """The rows of one run."""
    lines = [
        {"metric": metric, "value": value, "lo": low, "hi": high}
        for metric, (value, low, high) in FIGURES.items()
    ]
    table = pd.DataFrame(lines).assign(
        run="0123456789abcdef", method="ngp", scene="totem", resolution="64x48", n=7
    )
    whole = table["metric"].str.match("size_bytes|peak_bytes|train_s")
    table["phase"] = np.where(whole, "all", "steady")
    return table.reindex(columns=COLUMNS)


@pytest.fixture
def rows_with_cold(rows: pd.DataFrame) -> pd.DataFrame:
    """The same of a method that looks back: two cold frames, 3 dB worse and half as fast."""
    cold = rows[rows["phase"] == "steady"].assign(phase="cold", n=2)
    figures = ["value", "lo", "hi"]
    cold.loc[cold["metric"] == "psnr", figures] -= 3
    cold.loc[cold["metric"].str.match("frame_ms|stage_ms"), figures] *= 2
    cold.loc[cold["metric"] == "fps", figures] /= 2
    return pd.concat([rows, cold], ignore_index=True)


@pytest.fixture
def run(store: Store, stored_run: str) -> Run:
    """A run of six scored frames, three of them pictured."""
    (found,) = load(store, {stored_run: "run"})
    return found


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that would be saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: figures.append(figure))
    return figures


@pytest.fixture
def several(store: Store, stored_run: str) -> tuple[Store, dict[str, str]]:
    """A store with six runs of the same frames, and what each is called.

    The last was made on another machine; all else is the same.
    """
    labels = {stored_run: "first"}
    for number in range(5):
        key = f"{number}{stored_run[1:]}"
        folder = shutil.copytree(store.folder / stored_run, store.folder / key)
        for file in ("rows.csv", "record.json"):
            text = (folder / file).read_text().replace(stored_run, key)
            (folder / file).write_text(text)
        labels[key] = f"copy {number}"
    record = json.loads((folder / "record.json").read_text())
    record["machine"]["cpu"] = "another"
    (folder / "record.json").write_text(json.dumps(record))
    return store, labels
