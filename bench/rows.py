"""The rows of a run: means over frames with their 95 % intervals, quantiles, single figures."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy import fft, special

from bench.kinds import Row, Rows
from bench.results import WHOLE

CONFIDENCE = 0.95
QUANTILES = (50, 95, 99)
UNITS = {
    **dict.fromkeys(("psnr", "cc_psnr", "psnr_to_first", "tpsnr"), "dB"),
    **dict.fromkeys(("frame_ms", "wall_ms", "stage_ms"), "ms"),
    **dict.fromkeys(("size_bytes", "peak_bytes", "train_peak_bytes"), "B"),
    **{"fps": "1/s", "work": "1/frame", "train_s": "s", "compile_s": "s"},
}
"""Units of metrics, by name up to the first dot; other metrics have no unit."""


def row_table(rows: Sequence[Row], **facts: Any) -> pd.DataFrame:
    """The table of `rows` with their units and the `facts` that all of them share."""
    units = [UNITS.get(row["metric"].split(".")[0], "1") for row in rows]
    return pd.DataFrame(rows).assign(unit=units, **facts)


def phase_rows(frames: pd.DataFrame) -> Rows:
    """Mean and interval of every column, quantiles of the frame time, frames per second.

    `frames` are at least one, in path order, with columns `frame`, `name` and `phase`, scores,
    times, work.
    """
    columns = list(map(str, frames))
    scores = columns[columns.index("phase") + 1 : columns.index("frame_ms")]
    costs = [name for name in columns if name.startswith(("wall_ms", "stage_ms.", "work."))]
    times, ms = frames["frame_ms"], mean_row("frame_ms", frames["frame_ms"])
    return [
        *score_rows(frames, scores),
        ms,
        *(single(f"frame_ms.p{part}", np.percentile(times, part)) for part in QUANTILES),
        # No upper end if the interval of the time reaches 0.
        {"metric": "fps", "n": ms["n"], "value": 1000 / ms["value"], "lo": 1000 / ms["hi"]}
        | {"hi": 1000 / ms["lo"] if ms["lo"] > 0 else math.nan},
        *(mean_row(name, frames[name]) for name in costs),
    ]


def score_rows(frames: pd.DataFrame, scores: Sequence[str]) -> Rows:
    """Mean and interval of each of `scores`; of the flicker only where a frame has one."""
    named = [name for name in scores if name != "flicker" or frames[name].notna().any()]
    return [mean_row(name, frames[name]) for name in named]


def mean_row(metric: str, values: pd.Series) -> Row:
    """The row of a metric: mean and interval over the frames, in path order, that have a value."""
    known = values.dropna().to_numpy(dtype=float)
    value = known.mean() if len(known) else math.nan
    half = path_interval(known)
    figures = {"value": value, "n": len(known), "lo": value - half, "hi": value + half}
    return {"metric": metric} | figures


def single(metric: str, value: float) -> Row:
    """The row of a single figure; it belongs to the whole run unless its phase is replaced."""
    known = int(not math.isnan(value))
    row = {"metric": metric, "value": float(value), "n": known, "lo": math.nan, "hi": math.nan}
    return row | {"phase": WHOLE}


def half_interval(values: np.ndarray) -> float:
    """Half the t-interval of the mean of independent `values`; nan for < 2 or not finite ones."""
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    return _quantile(len(values) - 1) * values.std(ddof=1) / math.sqrt(len(values))


def path_interval(values: np.ndarray) -> float:
    """Half the interval of the mean of `values` [n], one per frame, in path order; nan as above.

    Neighbouring frames are alike, so n frames say less than n independent values. How uncertain the
    mean is follows from the slow part of the variation: the first B coefficients of the orthonormal
    cosine transform, B = 0.4 n^(2/3) rounded up. They are nearly independent, each with a variance
    near n times that of the mean, so their mean square gives a t-interval with B degrees of freedom
    (Lazarus et al. 2018, "HAR Inference: Recommendations for Practice"). All n - 1 coefficients
    would give `half_interval`. A block bootstrap needs more frames than a path has (docs/log.md).
    """
    if len(values) < 2 or not np.isfinite(values).all():
        return math.nan
    count = math.ceil(0.4 * len(values) ** (2 / 3))
    slow = fft.dct(values - values.mean(), norm="ortho")[1 : count + 1]
    return _quantile(count) * math.sqrt((slow**2).mean() / len(values))


def _quantile(freedom: int) -> float:
    """Quantile of Student's t: half-width, in standard errors, of an interval at `CONFIDENCE`."""
    return float(special.stdtrit(freedom, 0.5 + CONFIDENCE / 2))
