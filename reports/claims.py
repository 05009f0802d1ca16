"""What the paper concludes, claim by claim: how large a difference is there, and how large here."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pandas as pd

from bench.rows import half_interval, path_interval
from reports.comparison import shown_as
from reports.runs import Repeated, Run, grouped
from reports.tables import ABSENT, BOLD, Table, decimal

AS, LARGER, SMALLER = "as in the paper", "larger", "smaller"
AT_MOST = "smaller, if any"
AGREES = "same direction"
"""Of a difference whose size the paper does not give, or whose size cannot be told here."""
OPPOSITE, OPEN, UNKNOWN = "opposite", "inconclusive", "not measured"
BY_ONE = " (one seed)"
"""Ends a verdict from the frames of one training, which another training may reverse."""

TIMES = ("frame_ms", "fps", "stage_ms")
RATIOS = (*TIMES, "work", "size_bytes")
"""Metrics, by name up to the first dot, whose figures are compared by their ratio: a difference
would depend on machine and scene. `TIMES` can be compared on one machine only."""


@dataclass(frozen=True)
class Claim:
    """`metric` grows from each of the `lines` (keys) to the next or, if `alike`, hardly grows.

    Differences that are apart by no more than `margin` count as equal: in the unit of the metric,
    or as a factor where figures are compared by their ratio. A finding of the paper `says` in words
    which quantity it is about; `main` ones stand out.
    """

    metric: str
    lines: Sequence[str]
    margin: float
    alike: bool = False
    says: str = ""
    main: bool = False


@dataclass(frozen=True)
class Gap:
    """How far one line is above another in a metric, the mean `by` over what `over` says.

    Of metrics that are compared by their ratio, its logarithm. `half` is half the 95 % interval,
    nan if unknown; `proves` says whether it accounts for differences between trainings.
    """

    by: float
    half: float
    over: str
    proves: bool


NOT_MEASURED = Gap(math.nan, math.nan, "", False)


@dataclass(frozen=True)
class Comparison:
    """A claim about two lines, by their labels: their gap in the `paper`, nan if it gives none, and
    `here`. It is made in a `table`, with the figures of a `data_set` if that is a further one."""

    claim: Claim
    smaller: str
    larger: str
    paper: float
    here: Gap
    table: str = ""
    data_set: str = ""

    @property
    def verdict(self) -> str:
        """Whether the gap is here as it is in the paper; it tells the sign and the size apart."""
        if (word := self._verdict) in (OPEN, UNKNOWN) or self.here.proves:
            return word
        return word + BY_ONE

    @property
    def _verdict(self) -> str:
        if math.isnan(self.here.by):
            return UNKNOWN
        low, high = self.here.by - self.here.half, self.here.by + self.here.half
        margin = math.log(self.claim.margin) if by_ratio(self.claim.metric) else self.claim.margin
        if self.claim.alike:  # "hardly any loss" holds of a gain, too
            return AS if high <= margin else LARGER if low > margin else OPEN
        if high < 0:
            return OPPOSITE
        if low > 0 and math.isnan(self.paper):
            return AGREES
        if low > self.paper + margin:
            return LARGER
        if high < self.paper - margin:
            return SMALLER if low > 0 else AT_MOST
        if low > 0:
            return AS if self.here.half <= max(self.paper, margin) else AGREES
        return OPEN


def compare(
    claim: Claim, lines: Mapping[str, Repeated], published: Mapping[str, float]
) -> Iterator[Comparison]:
    """A claim between all of its neighbours among `lines`; `published` is the paper's metric. Both
    are by key.

    Where the paper has the opposite order, on another data set, a claim of growth is turned round.
    Where it gives the metric, but not of both lines, it claims nothing about them.
    """
    for smaller, larger in pairwise(claim.lines):
        known = (published.get(x, math.nan) for x in (smaller, larger))
        says, paper = claim.says, apart(claim.metric, *known)
        if published and math.isnan(paper):
            continue
        if paper < 0 and not claim.alike:
            smaller, larger, paper, says = larger, smaller, -paper, ""
        if smaller in lines and larger in lines and smaller != larger:
            one, other = lines[smaller], lines[larger]
            here = gap(claim.metric, one, other)
            yield Comparison(replace(claim, says=says), one.label, other.label, paper, here)


def apart(metric: str, one: float, other: float) -> float:
    """How far `other` is above `one`, as in `Gap`; nan if either is not known or has no ratio."""
    if not by_ratio(metric):
        return 0.0 if one == other else other - one  # of equal pictures, both are infinite
    return math.log(other / one) if one > 0 and other > 0 else math.nan


def gap(metric: str, one: Repeated, other: Repeated) -> Gap:
    """How far `other` is above `one` here: the mean over pairs; NOT_MEASURED if there are none.

    A pair has the same scene and the same seed. The interval is over scenes, of a single scene over
    seeds. If there is only one pair, its frames are compared.
    """
    pairs = [
        (run, twin)
        for run in one.averaged
        for twin in other.averaged
        if _identity(run, metric) == _identity(twin, metric)
        and None not in (run.figure(metric), twin.figure(metric))
    ]
    if not pairs:
        return NOT_MEASURED
    by_scene = grouped(pairs, lambda pair: pair[0].digest).values()
    of_scenes = [[_apart(metric, *pair) for pair in of_scene] for of_scene in by_scene]
    # The seeds of a scene share what is particular to it: of several scenes, each is one sample.
    means = [float(np.mean(of_scene)) for of_scene in of_scenes]
    by = float(np.mean(means))
    if metric.startswith("size_bytes"):
        return Gap(by, 0.0, "computed, not sampled", True)
    if len(pairs) == 1:
        return Gap(by, *_over_frames(metric, *pairs[0]), False)
    counts = {"scenes": len(means), "seeds": len({run.facts["seed"] for run, _ in pairs})}
    over = " × ".join(f"{count} {kind}" for kind, count in counts.items() if count > 1)
    samples = means if len(means) > 1 else of_scenes[0]
    return Gap(by, half_interval(np.array(samples)), over, True)


def _identity(run: Run, metric: str) -> tuple[object, ...]:
    """Scene and seed of a run and, if the metric is a time, its machine and the runs that were
    measured in turns with it: equal in a pair."""
    timed = metric.partition(".")[0] in TIMES
    when = (run.computer, run.record["made_of"].get("beside")) if timed else ()
    return (run.digest, run.facts["seed"], when)


def _apart(metric: str, run: Run, twin: Run) -> float:
    """How far the figure of `twin` is above that of `run`.

    One perfect frame makes a mean PSNR infinite. If both are, the frames are compared.
    """
    low, high = run.figure(metric), twin.figure(metric)
    assert low is not None
    assert high is not None
    if math.isinf(low) and low == high and len(pairs := _frame_pairs(metric, run, twin)):
        return float(np.mean([apart(metric, *pair) for pair in pairs]))
    return apart(metric, low, high)


def _frame_pairs(metric: str, run: Run, twin: Run) -> np.ndarray:
    """The figures [N, 2] of the steady frames that both runs have; those of a stage include the
    stages inside it."""
    both = []
    for frames in (run.steady.set_index("frame"), twin.steady.set_index("frame")):
        names = map(str, frames)
        parts = [name for name in names if name == metric or name.startswith(f"{metric}/")]
        both.append(frames[parts].sum(axis=1, min_count=1).dropna())
    return pd.concat(both, axis=1, join="inner").to_numpy()


def _over_frames(metric: str, run: Run, twin: Run) -> tuple[float, str]:
    """Half the interval of the gap between two runs, from the frames that both have, and over what;
    nan if the frames have no figures."""
    pairs = _frame_pairs(metric, run, twin)
    if len(pairs) < 2:
        return math.nan, "one figure each"
    if by_ratio(metric):
        # A mean that is wrong by a small share shifts the logarithm by this share.
        below, above = (pairs / pairs.mean(axis=0)).T
        by_frame = above - below
    else:
        by_frame = np.array([apart(metric, *pair) for pair in pairs])
    return path_interval(by_frame), f"{len(pairs)} frames of one seed"


def by_ratio(metric: str) -> bool:
    return metric.partition(".")[0] in RATIOS


def told(metric: str, by: float) -> str:
    """A gap as text: +0.61 or ×1.25."""
    if math.isnan(by):
        return ABSENT
    if not by_ratio(metric):
        return ("-" if by < 0 else "+") + shown_as(metric).write(abs(by))
    factor = math.exp(by)
    if factor < 0.1:
        return f"×{factor:.2g}"
    return f"×{decimal(factor, 2 if factor < 10 else 1 if factor < 100 else 0)}"


def finding_table(comparisons: Sequence[Comparison]) -> Table:
    """The findings of the paper among `comparisons`, those that were measured.

    Where a further data set has the same figures, as sizes have, the first line is enough.
    """
    first: dict[tuple[str, ...], Comparison] = {}
    for each in comparisons:
        if each.claim.says and each.here is not NOT_MEASURED:
            first.setdefault((each.claim.says, *_figures(each), each.verdict), each)
    columns = ("quantity", "paper", "here", "95 % interval", "against the paper")
    lines = [(_quantity(each), *figures) for (_, *figures), each in first.items()]
    return Table("What the paper says, and what was found", columns, lines)


def _quantity(each: Comparison) -> str:
    """What a finding is about, on which further data set, in which unit; main ones are bold."""
    unit = " (dB)" if each.claim.metric == "psnr" else ""
    quantity = ", ".join(filter(None, (each.claim.says, each.data_set))) + unit
    return BOLD[0] % quantity if each.claim.main else quantity


def _figures(each: Comparison) -> tuple[str, str, str]:
    metric, here = each.claim.metric, each.here
    ends = (told(metric, here.by + side * here.half) for side in (-1, 1))
    interval = " – ".join(ends) if here.half > 0 else ""
    return told(metric, each.paper), told(metric, here.by), interval


def claim_table(comparisons: Sequence[Comparison]) -> Table:
    lines = []
    for each in comparisons:
        metric = each.claim.metric
        label = shown_as(metric).name
        sign = "≈" if each.claim.alike else "<"
        where = ", ".join(filter(None, (each.table, each.data_set, label)))
        name = f"{where}: {each.smaller} {sign} {each.larger}"
        margin = f"×{each.claim.margin:g}" if by_ratio(metric) else f"{each.claim.margin:g}"
        figures = (*_figures(each), each.here.over, margin)
        lines.append((name, *figures, each.verdict))
    columns = ("claim", "paper", "here", "95 % interval", "over", "margin", "against the paper")
    return Table("All comparisons", columns, tuple(lines))
