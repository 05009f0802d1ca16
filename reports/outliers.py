"""Finds runs that look broken. Each rule is a function that yields outliers with the reason."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from statistics import median
from typing import Any

from omegaconf import OmegaConf

from bench.results import content_key
from bench.trajectories import MIXED
from reports.runs import Run
from reports.tables import Table

REFERENCES = Path(__file__).parent / "paper" / "scenes.yaml"  # published PSNR of well-known scenes

OTHER_SCENES_DB = 12.0
"""An outlier is this far below the median over a method's scenes. drums, the hardest scene of
NeRF-Synthetic, is 9 dB below the median of the eight."""

REFERENCE_DB = 10.0  # an outlier is this far below the published PSNR of the same scene

INT8_DB = 1.0
"""An outlier is this far below the same network in fp32. The paper's int8 loses 0.6 dB to FP16."""

OUTSIDE_STAGES, OUTSIDE_MS = 0.02, 3.0
"""Share of a frame's time allowed outside all stages, and ms that are always allowed: placing the
camera and assembling the result take two milliseconds even for a small frame."""

MORE_PIXELS = 4
"""With this many times the pixels a frame must take longer, though times drift by a factor of 2."""

FACTS = ("method", "scene", "budget", "precision", "seed")
"""Columns that identify a run for a reader."""


@dataclass(frozen=True)
class Outlier:
    key: str
    why: str


def outliers(runs: Sequence[Run]) -> list[Outlier]:
    of_psnr = (*far_from_other_scenes(runs), *far_from_reference(runs), *int8_far_from_fp32(runs))
    return [*of_psnr, *stages_do_not_add_up(runs), *faster_with_more_pixels(runs)]


def far_from_other_scenes(runs: Sequence[Run]) -> Iterator[Outlier]:
    """PSNR far below the median over at least three scenes with the same method and settings."""
    scored = [run for run in runs if math.isfinite(_psnr(run))]
    for group in _grouped(scored, lambda run: _settings(run, "scene", "seed", "method.seed")):
        scenes = _grouped(group, lambda run: run.facts["scene"])
        usual = median(median(map(_psnr, of_scene)) for of_scene in scenes)
        for run in group:
            below = usual - _psnr(run)
            if len(scenes) > 2 and below > OTHER_SCENES_DB:
                why = f"PSNR {below:.1f} dB below the median of {len(scenes)} scenes"
                yield Outlier(run.key, why)


def far_from_reference(runs: Sequence[Run]) -> Iterator[Outlier]:
    """PSNR after a whole training far below the one published for the same scene and size."""
    published: Any = OmegaConf.load(REFERENCES)
    for run in runs:
        share = run.record["made_of"]["config"]["method"].get("after", 1)
        known = published["psnr"].get(run.facts["scene"], math.nan)
        below = known - _psnr(run)
        whole = share == 1 and run.facts["resolution"] == published["resolution"]
        if whole and below > REFERENCE_DB:
            why = f"PSNR {below:.1f} dB below the published {known} dB of {published['method']}"
            yield Outlier(run.key, why)


def stages_do_not_add_up(runs: Sequence[Run]) -> Iterator[Outlier]:
    """The stages, if they were timed, do not sum up to the frame time."""
    for run in runs:
        frame = run.values["frame_ms"]
        stages = {name: ms for name, ms in run.values.items() if name.startswith("stage_ms.")}
        stages.pop("stage_ms.other", None)
        if not stages:  # those of a worker in another program may tell none
            continue
        named = math.fsum(stages.values())
        off = abs(frame - named) > OUTSIDE_STAGES * frame + OUTSIDE_MS
        if off and run.record["protocol"]["stages"]:
            yield Outlier(run.key, f"its stages take {named:.2f} ms, its frames {frame:.2f} ms")


def int8_far_from_fp32(runs: Sequence[Run]) -> Iterator[Outlier]:
    """int8 loses more than rounding explains; uncalibrated int8 has no known limit."""
    for group in _grouped(runs, lambda run: _settings(run, "engine", "precision", "method.engine")):
        exact = [_psnr(run) for run in group if run.facts["precision"] == "fp32"]
        for run in group:
            lost = max(exact, default=math.nan) - _psnr(run)
            precision = run.facts["precision"]
            calibrated = precision.startswith("int8") and "uncalibrated" not in precision
            if calibrated and lost > INT8_DB:
                yield Outlier(run.key, f"int8 {lost:.2f} dB below fp32")


def faster_with_more_pixels(runs: Sequence[Run]) -> Iterator[Outlier]:
    """Faster than the same settings with far fewer pixels; only for frames of one size."""
    sized = [run for run in runs if run.facts["resolution"] != MIXED]
    size = ("scene.width", "scene.height", "scene.downscale", "seed", "method.seed")
    for group in _grouped(sized, lambda run: (_settings(run, *size), run.computer)):
        for one, other in permutations(group, 2):
            fewer, more = one.values["frame_ms"], other.values["frame_ms"]
            if _pixels(other) >= MORE_PIXELS * _pixels(one) and more < fewer:
                at = f"{more:.1f} ms a frame at {other.facts['resolution']}"
                yield Outlier(other.key, f"{at}, {fewer:.1f} ms at {one.facts['resolution']}")


def outlier_table(found: Sequence[Outlier], runs: Sequence[Run]) -> Table:
    facts = {run.key: run.facts for run in runs}
    lines = tuple(
        (outlier.key, *(str(facts[outlier.key][name]) for name in FACTS), outlier.why)
        for outlier in found
        if outlier.key in facts
    )
    return Table("Outliers: runs that look broken", ("run", *FACTS, "why"), lines)


def _psnr(run: Run) -> float:
    return run.values.get("psnr", math.nan)


def _pixels(run: Run) -> int:
    return math.prod(map(int, run.facts["resolution"].split("x")))


def _grouped(runs: Sequence[Run], key: Callable[[Run], object]) -> list[list[Run]]:
    groups: dict[object, list[Run]] = {}
    for run in runs:
        groups.setdefault(key(run), []).append(run)
    return list(groups.values())


def _settings(run: Run, *without: str) -> str:
    """A key that is equal for runs with equal settings, ignoring the settings in `without`."""
    config = run.record["made_of"]["config"]
    kept = {name: of for name, of in config.items() if name not in without}
    for name in without:
        group, _, setting = name.partition(".")
        if setting and group in kept:
            kept[group] = {key: value for key, value in kept[group].items() if key != setting}
    return content_key(kept)
