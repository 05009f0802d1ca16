"""Comparison of runs with earlier ones: metric by metric, in pairs of seeds and of frames."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.errors import SteerbenchError, unexpected, unknown
from bench.kinds import Words
from bench.rows import half_interval, path_interval
from reports.runs import Run
from reports.tables import NETS, QUALITY, Table


@dataclass(frozen=True)
class Limit:
    """How much worse a metric may become: `absolute` in its `unit`, `relative` to the old figure.

    `better` is 1 where more is better, else -1. With `here`, it is compared on one machine only.
    """

    better: int
    absolute: float = 0.0
    relative: float = 0.0
    here: bool = False
    unit: str = ""

    def __str__(self) -> str:
        return f"{100 * self.relative:.4g} %" if self.relative else f"{self.absolute:.4g}"


Limits = Mapping[str, Limit]  # by metric

LIMITS: Limits = {
    "psnr": Limit(1, absolute=0.1, unit="dB"),
    "ssim": Limit(1, absolute=0.002),
    **{f"lpips_{net}": Limit(-1, absolute=0.003) for net in NETS},
    "flicker": Limit(-1, relative=0.05),
    "size_bytes.total": Limit(-1, relative=0.001, unit="bytes"),
    "work.samples": Limit(-1, relative=0.05),
    "work.products": Limit(-1, relative=0.05),
    "frame_ms": Limit(-1, relative=0.25, here=True, unit="ms"),
    "peak_bytes": Limit(-1, relative=0.2, here=True, unit="bytes"),
}
"""The metrics that are compared, unless a baseline has limits of its own."""


def limited(words: Words, limits: Limits = LIMITS) -> dict[str, Limit]:
    """`limits` with those of `words` (psnr=0.2, frame_ms=10%); SteerbenchError if one is wrong."""
    directions = {metric: {"↑": 1, "↓": -1}.get(of.better) for metric, of in QUALITY.items()}
    known = {**{name: Limit(better) for name, better in directions.items() if better}, **LIMITS}
    found = dict(limits)
    for word in words:
        metric, _, text = word.partition("=")
        if metric not in known:
            raise unknown("metric", metric, known)
        if not (read := re.fullmatch(r"(\d+\.?\d*)(%?)", text)):
            raise unexpected(f"--limit {metric}", "as 0.2 in its unit, or 10%", text or "nothing")
        amount, share = float(read[1]), read[2] == "%"
        absolute, relative = amount * (not share), amount / 100 * share
        found[metric] = replace(known[metric], absolute=absolute, relative=relative)
    return found


@dataclass(frozen=True)
class Figures:
    """The figures of a run that later runs are compared with: its headline `values`, by metric.

    `frames` has the figures that the headline averages, by metric and by number and name of the
    frame, in the order of the path: of qualities the steady frames that have them, of other
    metrics all steady frames. `machine` names its device and processors. `views` is equal for the
    same frames of the same scene under one protocol: a scene that steerbench draws is known by its
    name, because its pictures differ by a level of 255 on another processor.
    """

    values: Mapping[str, float]
    frames: Mapping[str, Mapping[str, float]]
    machine: str
    views: str

    @classmethod
    def of(cls, run: Run, limits: Limits = LIMITS) -> Figures:
        values = {x: of for x, of in run.values.items() if x in limits and not math.isnan(of)}
        steady, frames = run.steady, {}
        for metric in values:
            if metric not in steady:
                continue
            averaged = steady.dropna(subset=[metric]) if metric in QUALITY else steady
            names = averaged["frame"].astype(str) + ": " + averaged["name"].fillna("")
            if averaged[metric].notna().all():
                frames[metric] = dict(zip(names, averaged[metric].astype(float), strict=True))
        views = [*map(str, run.views), run.rules]
        scene = run.config.get("scene", {})
        if scene.get("_target_") == "bench.scenes.embedded.load":
            views[0] = str(run.facts["scene"])
        return cls(values, frames, ", ".join(run.computer), ", ".join(views))


@dataclass(frozen=True)
class Assertion:
    """That a metric of a run is as good `now` as it `was`; `now` is nan if the new run lacks it.

    `change` is new less old: the mean over the frames that both runs have, where frames are known,
    and over the seeds. `interval` is the 95 % interval of that mean, over the seeds, with one seed
    over its frames; None where only two figures are known. The `verdict` is "worse" (by more than
    its limit and not by chance), "missing" (it, a frame or the `run` is gone) or "".
    """

    metric: str
    was: float
    now: float
    change: float
    interval: tuple[float, float] | None
    limit: Limit
    verdict: str
    run: str = ""
    note: str = ""  # what else to know of the run

    def __str__(self) -> str:
        share = self.limit.relative and self.was
        by, unit = (100 / abs(self.was), "%") if share else (1.0, self.limit.unit)
        change = f" {by * self.change:+.3g} {unit}".rstrip() + f" (limit {self.limit})"
        return self.metric + change * (self.verdict != "missing")


def changes(
    old: Sequence[Figures], new: Sequence[Figures], limits: Limits = LIMITS
) -> Iterator[Assertion]:
    """The change of every metric of `old` that has a limit, over runs with the same seeds.

    A change beyond its limit is chance where its interval contains 0, unless one frame alone moves
    the mean beyond the limit. Then that frame is broken; but a time may be long by chance. The
    interval over several seeds holds what rounding does to a training where another processor adds
    in another order; that over the frames of one training does not. Raises SteerbenchError if the
    runs rendered other frames.
    """
    pairs = list(zip(old, new, strict=True))
    for before, after in pairs:
        if before.views != after.views:
            raise SteerbenchError(
                "these are figures of other frames, expected those of one scene, size and "
                f"protocol: {before.views}; {after.views}"
            )
    here = all(before.machine == after.machine for before, after in pairs)
    for metric, limit in limits.items():
        if any(metric in each.values for each in old) and (here or not limit.here):
            yield _change(metric, limit, pairs)


def _change(metric: str, limit: Limit, pairs: Sequence[tuple[Figures, Figures]]) -> Assertion:
    frames = [_hiding_nothing(_frames_apart(metric, *pair), limit) for pair in pairs]
    values = np.array([[run.values.get(metric, math.nan) for run in pair] for pair in pairs])
    by_seed = np.array(
        [
            of_frames.mean() if len(of_frames) > 1 else _apart(*pair)
            for of_frames, pair in zip(frames, values, strict=True)
        ]
    )
    by_seed = _hiding_nothing(by_seed, limit)
    before, after = map(float, values.mean(axis=0))
    by, interval = float(by_seed.mean()), None
    if len(pairs) > 1 or len(frames[0]) > 1:
        half = half_interval(by_seed) if len(pairs) > 1 else path_interval(frames[0])
        interval = (by - half, by + half)
    lost = -limit.better * by
    allowed = limit.absolute
    if limit.relative:
        allowed += limit.relative * abs(before)
    sure = interval is None or lost - half > 0 or _broken(frames, limit) > allowed
    verdict = "worse" if sure and lost > allowed else ""
    if math.isnan(before + after) or _lacks_frames(metric, pairs):  # of a seed, too
        verdict = "missing"
    return Assertion(metric, before, after, by, interval, limit, verdict)


def _broken(frames: Sequence[np.ndarray], limit: Limit) -> float:
    """By how much the worst frame alone moves the mean over frames and seeds; of times, which may
    be long by chance, not at all."""
    if limit.here:
        return 0.0
    moved = [
        (-limit.better * of_seed).max() / len(of_seed) for of_seed in frames if len(of_seed) > 1
    ]
    return max(moved, default=0.0) / len(frames)


def _lacks_frames(metric: str, pairs: Sequence[tuple[Figures, Figures]]) -> bool:
    """Whether a run lacks a frame that an earlier one has."""
    return any(
        old.frames.get(metric, {}).keys() - new.frames.get(metric, {}).keys() for old, new in pairs
    )


def _frames_apart(metric: str, old: Figures, new: Figures) -> np.ndarray:
    """New less old of the frames that both have, in the order of the path."""
    one, other = old.frames.get(metric, {}), new.frames.get(metric, {})
    return np.array([_apart(one[name], other[name]) for name in one if name in other])


def _hiding_nothing(changes: np.ndarray, limit: Limit) -> np.ndarray:
    """The `changes`, those of pictures that became perfect as 0: their gain, which is infinite,
    would hide what others lost."""
    return np.where(limit.better * changes == math.inf, 0.0, changes)


def _apart(old: float, new: float) -> float:
    """New less old; 0 of equal pictures, whose PSNR is infinite."""
    return 0.0 if old == new else new - old


def change_table(title: str, found: Sequence[Assertion]) -> Table:
    lines = []
    for change in found:
        interval = " – ".join(f"{end:+.4g}" for end in change.interval or ())
        figures = (f"{change.was:.6g}", f"{change.now:.6g}", f"{change.change:+.4g}", interval)
        lines.append((change.metric, *figures, str(change.limit), change.verdict))
    columns = ("metric", "was", "is", "change", "95 % interval", "limit", "")
    return Table(title, columns, tuple(lines))
