"""Whether a run is as good as an earlier one: metric by metric, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from bench.errors import SteerbenchError
from bench.results import STEADY
from bench.run import half_interval
from reports.runs import Run
from reports.tables import QUALITY, Table


@dataclass(frozen=True)
class Limit:
    """How much worse a metric may become.

    Attributes:
        better: 1 where more is better, -1 where less is.
        absolute: in the unit of the metric.
        relative: share of what it was.
        here: it depends on the machine, and is compared on the same one only.
    """

    better: int
    absolute: float = 0.0
    relative: float = 0.0
    here: bool = False


LIMITS: Mapping[str, Limit] = {
    "psnr": Limit(1, absolute=0.1),
    "ssim": Limit(1, absolute=0.002),
    "lpips_alex": Limit(-1, absolute=0.003),
    "lpips_vgg": Limit(-1, absolute=0.003),
    "lpips_squeeze": Limit(-1, absolute=0.003),
    "flicker": Limit(-1, relative=0.05),
    "size_bytes.total": Limit(-1, relative=0.001),
    "frame_ms": Limit(-1, relative=0.25, here=True),
    "peak_bytes": Limit(-1, relative=0.2, here=True),
}
"""What is compared, unless a baseline says otherwise."""

LARGEST = ("peak_bytes",)
"""Metrics whose headline is the largest figure of a frame, not the mean of all."""


@dataclass(frozen=True)
class Figures:
    """What is kept of a run to compare later ones with.

    Attributes:
        values: of its headline, by metric.
        frames: what the headline is the mean of, by metric and by number and name of the frame:
            of qualities, the steady frames with ground truth, else all steady ones.
        machine: name of its processor and graphics processors.
        views: the same where the same frames of the same scene were rendered by one protocol.
    """

    values: Mapping[str, float]
    frames: Mapping[str, Mapping[str, float]]
    machine: str
    views: str

    @classmethod
    def of(cls, run: Run, limits: Mapping[str, Limit] = LIMITS) -> Figures:
        """The figures of `run` that have a limit."""
        values = {
            metric: run.values[metric]
            for metric in limits
            if math.isfinite(run.values.get(metric, math.nan))
        }
        steady = run.frames[run.frames["phase"] == STEADY]
        steady = steady if len(steady) else run.frames
        scored = steady.dropna(subset=["psnr"])
        frames = {}
        for metric in values:
            if metric in run.frames and metric not in LARGEST:
                averaged = scored if metric in QUALITY else steady
                names = averaged["frame"].astype(str) + ": " + averaged["name"].fillna("")
                if averaged[metric].notna().all():
                    frames[metric] = dict(zip(names, averaged[metric].astype(float), strict=True))
        machine = run.record["machine"]
        views = ", ".join(map(str, (*run.views, run.facts["protocol"])))
        return cls(values, frames, ", ".join((machine["cpu"], *machine["gpus"])), views)


@dataclass(frozen=True)
class Change:
    """What became of one metric.

    Attributes:
        old, new: `new` is nan where the metric is gone.
        by: new less old; of metrics that frames have, the mean over those that both runs have.
        interval: of that mean over the frames, 95 %; None where only two figures are known.
        verdict: "" as good, "worse" by more than its limit, "missing" if it or a frame is gone.
    """

    metric: str
    old: float
    new: float
    by: float
    interval: tuple[float, float] | None
    verdict: str


def changes(old: Figures, new: Figures, limits: Mapping[str, Limit] = LIMITS) -> Iterator[Change]:
    """What became of every metric of `old` that has a limit.

    Raises:
        SteerbenchError: the runs rendered other frames.
    """
    if old.views != new.views:
        raise SteerbenchError(
            "these are figures of other frames, expected those of one scene, size and protocol: "
            f"{old.views}; {new.views}"
        )
    for metric, limit in limits.items():
        if metric not in old.values or (limit.here and old.machine != new.machine):
            continue
        before, after = old.values[metric], new.values.get(metric, math.nan)
        by, interval = after - before, None
        one, other = old.frames.get(metric, {}), new.frames.get(metric, {})
        both = [name for name in one if name in other]
        if len(both) > 1:
            apart = np.array([other[name] - one[name] for name in both])
            by = float(apart.mean())
            half = half_interval(apart)
            interval = (by - half, by + half)
        worse = limit.better * by < -limit.absolute - limit.relative * abs(before)
        gone = math.isnan(after) or len(both) < len(one)
        verdict = "missing" if gone else "worse" if worse else ""
        yield Change(metric, before, after, by, interval, verdict)


def table(title: str, found: Sequence[Change]) -> Table:
    """`found` as a table."""
    columns = ("metric", "was", "is", "change", "95 % interval", "")
    return Table(title, columns, tuple(map(_line, found)))


def _line(change: Change) -> tuple[str, ...]:
    ends = () if change.interval is None else change.interval
    return (
        change.metric,
        f"{change.old:.6g}",
        f"{change.new:.6g}",
        f"{change.by:+.4g}",
        " – ".join(f"{end:+.4g}" for end in ends),
        change.verdict,
    )
