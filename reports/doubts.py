"""Rows that look broken: rules, each a function of runs, that say which to doubt and why."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from statistics import median

from bench.results import content_key
from bench.trajectories import MIXED
from reports.runs import Run
from reports.tables import Table

REFERENCES = Path(__file__).parent / "paper" / "scenes.toml"
"""PSNR that Instant-NGP reaches on well-known scenes."""

OTHER_SCENES_DB = 12.0
"""Below the median of a method's scenes. The hardest scene of NeRF-Synthetic, drums, is 9 dB below
that of Instant-NGP's eight."""

REFERENCE_DB = 10.0
"""Below what Instant-NGP reaches on the same scene."""

INT8_DB = 1.0
"""Below the same network in fp32; the paper's own loss, against FP16, is 0.6 dB."""

OUTSIDE_STAGES = 0.02
"""Share of a frame's time that may lie in no stage."""

MORE_PIXELS = 4
"""So many times as many must take longer, though times of a machine drift by a factor of two."""

FACTS = ("method", "scene", "budget", "precision", "seed")
"""What tells runs apart for people."""


@dataclass(frozen=True)
class Doubt:
    """Why the run `key` is to be doubted."""

    key: str
    why: str


def doubts(runs: Sequence[Run]) -> list[Doubt]:
    """What every rule has against `runs`."""
    references = tomllib.loads(REFERENCES.read_text(encoding="utf-8"))["psnr"]
    return [
        *far_from_other_scenes(runs),
        *far_from_reference(runs, references),
        *stages_do_not_add_up(runs),
        *int8_far_from_fp32(runs),
        *faster_with_more_pixels(runs),
    ]


def far_from_other_scenes(runs: Sequence[Run]) -> Iterator[Doubt]:
    """PSNR far below the median of the same method and settings on at least three scenes."""
    scored = [run for run in runs if math.isfinite(_psnr(run))]
    for same in _alike(scored, lambda run: _settings(run, "scene", "seed", "method.seed")):
        scenes: dict[str, list[float]] = {}
        for run in same:
            scenes.setdefault(run.facts["scene"], []).append(_psnr(run))
        usual = median(median(values) for values in scenes.values())
        for run in same:
            below = usual - _psnr(run)
            if len(scenes) > 2 and below > OTHER_SCENES_DB:
                yield Doubt(
                    run.key, f"PSNR {below:.1f} dB below the median of {len(scenes)} scenes"
                )


def far_from_reference(runs: Sequence[Run], references: Mapping[str, float]) -> Iterator[Doubt]:
    """PSNR far below what is known of the scene."""
    for run in runs:
        known = references.get(run.facts["scene"], math.nan)
        below = known - _psnr(run)
        if below > REFERENCE_DB:
            yield Doubt(run.key, f"PSNR {below:.1f} dB below the {known} dB of Instant-NGP")


def stages_do_not_add_up(runs: Sequence[Run]) -> Iterator[Doubt]:
    """The named stages of a frame are not what it takes."""
    for run in runs:
        frame = run.values["frame_ms"]
        named = math.fsum(
            ms
            for name, ms in run.values.items()
            if name.startswith("stage_ms.") and name != "stage_ms.other"
        )
        if abs(frame - named) > OUTSIDE_STAGES * frame:
            yield Doubt(run.key, f"its stages take {named:.2f} ms, its frames {frame:.2f} ms")


def int8_far_from_fp32(runs: Sequence[Run]) -> Iterator[Doubt]:
    """int8 loses more than rounding should."""
    for same in _alike(runs, lambda run: _settings(run, "engine", "precision", "method.engine")):
        exact = [_psnr(run) for run in same if run.facts["precision"] == "fp32"]
        for run in same:
            lost = max(exact, default=math.nan) - _psnr(run)
            if run.facts["precision"] == "int8" and lost > INT8_DB:
                yield Doubt(run.key, f"int8 {lost:.2f} dB below fp32")


def faster_with_more_pixels(runs: Sequence[Run]) -> Iterator[Doubt]:
    """Many times the pixels of another run of the same, in less time; of frames of one size."""
    size = ("scene.width", "scene.height", "scene.downscale", "seed", "method.seed")
    sized = [run for run in runs if run.facts["resolution"] != MIXED]
    for same in _alike(sized, lambda run: (_settings(run, *size), run.computer)):
        pixels = {run.key: _pixels(run) for run in same}
        for one, other in combinations(sorted(same, key=lambda run: pixels[run.key]), 2):
            fewer, more = one.values["frame_ms"], other.values["frame_ms"]
            if pixels[other.key] >= MORE_PIXELS * pixels[one.key] and more < fewer:
                at = f"{more:.1f} ms a frame at {other.facts['resolution']}"
                yield Doubt(other.key, f"{at}, {fewer:.1f} ms at {one.facts['resolution']}")


def table(found: Sequence[Doubt], runs: Sequence[Run]) -> Table:
    """`found` as a table; of runs that are not among `runs` nothing is shown."""
    facts = {run.key: run for run in runs}
    lines = tuple(
        (doubt.key, *(str(facts[doubt.key].facts[name]) for name in FACTS), doubt.why)
        for doubt in found
        if doubt.key in facts
    )
    return Table("Rows to be doubted", ("run", *FACTS, "why"), lines, figures=False)


def _psnr(run: Run) -> float:
    return run.values.get("psnr", math.nan)


def _pixels(run: Run) -> int:
    return math.prod(map(int, run.facts["resolution"].split("x")))


def _alike(runs: Sequence[Run], key: Callable[[Run], object]) -> list[list[Run]]:
    """Groups of runs that have the same `key`."""
    groups: dict[object, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())


def _settings(run: Run, *without: str) -> str:
    """The same for runs with the same settings, but for those `without`."""
    kept = {**run.record["made_of"]["config"]}
    for name in without:
        group, _, setting = name.partition(".")
        if not setting:
            kept.pop(group, None)
        elif group in kept:
            kept[group] = {key: value for key, value in kept[group].items() if key != setting}
    return content_key(kept)
