"""The rows of a run: means over frames with their intervals, quantiles, single figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from bench.intervals import path_interval
from bench.results import WHOLE

QUANTILES = (50, 95, 99)
UNITS = {
    **{
        "psnr": "dB",
        "psnr_to_first": "dB",
        "tpsnr": "dB",
        "jod": "JOD",
        "fps": "1/s",
        "work": "1/frame",
        "train_s": "s",
    },
    **{"frame_ms": "ms", "wall_ms": "ms", "stage_ms": "ms", "size_bytes": "B", "peak_bytes": "B"},
}
"""Units of metrics, by name up to the first dot; other metrics have no unit."""


def phase_rows(frames: pd.DataFrame) -> list[dict[str, Any]]:
    """Mean and interval of every column, quantiles of the frame time, frames per second.

    `frames` are at least one, in path order, with columns `frame`, `name` and `phase`, scores,
    times, work.
    """
    columns = list(map(str, frames))
    scores = columns[columns.index("phase") + 1 : columns.index("frame_ms")]
    parts = [name for name in columns if name.startswith(("stage_ms.", "work."))]
    times = frames["frame_ms"]
    ms = mean_row("frame_ms", times)
    return [
        *score_rows(frames, scores),
        ms,
        *(single(f"frame_ms.p{part}", np.percentile(times, part)) for part in QUANTILES),
        # No upper end if the interval of the time reaches 0.
        {"metric": "fps", "n": ms["n"], "value": 1000 / ms["value"], "lo": 1000 / ms["hi"]}
        | {"hi": 1000 / ms["lo"] if ms["lo"] > 0 else math.nan},
        *(mean_row(name, frames[name]) for name in columns if name == "wall_ms"),
        *(mean_row(name, frames[name]) for name in parts),
    ]


def score_rows(frames: pd.DataFrame, scores: Sequence[str]) -> list[dict[str, Any]]:
    """Mean and interval of each of `scores`; of the flicker only where a frame has one."""
    named = [name for name in scores if name != "flicker" or frames[name].notna().any()]
    return [mean_row(name, frames[name]) for name in named]


def mean_row(metric: str, values: pd.Series) -> dict[str, Any]:
    """The row of a metric: mean and interval over the frames, in path order, that have a value."""
    known = values.dropna().to_numpy(dtype=float)
    value = known.mean() if len(known) else math.nan
    half = path_interval(known)
    figures = {"value": value, "n": len(known), "lo": value - half, "hi": value + half}
    return {"metric": metric} | figures


def single(metric: str, value: float) -> dict[str, Any]:
    """The row of a single figure; it belongs to the whole run unless its phase is replaced."""
    known = int(not math.isnan(value))
    row = {"metric": metric, "value": float(value), "n": known, "lo": math.nan, "hi": math.nan}
    return row | {"phase": WHOLE}
