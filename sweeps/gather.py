"""Collects the runs of the paper's tables from the store, and why others are missing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import DictConfig

from bench.results import Store
from reports.runs import Repeated, Run, over_common_frames, over_scenes, readable
from sweeps import failures
from sweeps.configured import scene_digest, scene_folder
from sweeps.identity import job_key
from sweeps.plan import Planned


@dataclass(frozen=True)
class Outcome:
    """A job with its run, if there is one, and the reason why it is missing or in doubt."""

    job: Planned
    run: Run | None
    gap: str | None


def newest(store: Store) -> dict[str, list[Run]]:
    """The latest run of each job and scene, by job key, newest first.

    A job has several if its settings fit scenes in different folders.
    """
    of_jobs: dict[str, dict[str, Run]] = {}
    for run in reversed(readable(store)):
        parts = run.record["made_of"]
        if "config" in parts:
            of_job = of_jobs.setdefault(job_key(parts["config"], parts.get("turns", "")), {})
            of_job.setdefault(run.record["scene"]["digest"], run)
    return {job: list(of_scenes.values()) for job, of_scenes in of_jobs.items()}


def gather(
    jobs: Sequence[Planned], runs: Mapping[str, Sequence[Run]], outputs: Path
) -> dict[str, list[Repeated]]:
    """The lines of every table, each with its runs and the reasons why others are missing.

    With several scenes, a run of a line is the mean of one seed over the scenes that all lines of
    the block have. Lines without any measurement are ignored for this.

    Args:
        runs: as returned by `newest`.
    """
    blocks: dict[tuple[str, str], dict[str, list[Outcome]]] = {}
    for job in jobs:
        line = blocks.setdefault((job.table, job.block), {}).setdefault(job.line, [])
        line.append(_outcome(job, runs, outputs))
    tables: dict[str, list[Repeated]] = {}
    for (table, _), of_block in blocks.items():
        tables.setdefault(table, []).extend(_lines(of_block))
    return tables


def _outcome(job: Planned, runs: Mapping[str, Sequence[Run]], outputs: Path) -> Outcome:
    failure = failures.last(outputs, job.settings)
    shown = (run for run in runs.get(job.key, ()) if of_scene(run, job.config))
    if run := next(shown, None):
        why = failure and f"failed when it was tried again: {failure}"
        return Outcome(job, replace(run, label=job.line), why)
    return Outcome(job, None, f"failed: {failure}" if failure else "not measured yet")


def of_scene(run: Run, config: DictConfig) -> bool:
    """Whether `run`, which has the settings of `config`, also has its scene.

    The settings do not tell apart folders with the same last name. If the folder does not exist
    here, only this name counts.
    """
    folder = scene_folder(config)
    if folder is None or run.record.get("scene_path") == folder or not Path(folder).is_dir():
        return True
    return run.record["scene"]["digest"] == scene_digest(config)


def _lines(of_block: Mapping[str, Sequence[Outcome]]) -> list[Repeated]:
    of_block = _over_common_frames(of_block)
    measured = [{each.job.scene for each in line if each.run} for line in of_block.values()]
    common = set.intersection(*filter(None, measured)) if any(measured) else set()
    return [_line(label, outcomes, common) for label, outcomes in of_block.items()]


def _over_common_frames(of_block: Mapping[str, Sequence[Outcome]]) -> dict[str, list[Outcome]]:
    every = [each for line in of_block.values() for each in line]
    runs = iter(over_common_frames([each.run for each in every if each.run]))
    return {
        label: [replace(each, run=next(runs)) if each.run else each for each in line]
        for label, line in of_block.items()
    }


def _line(label: str, outcomes: Sequence[Outcome], common: set[str]) -> Repeated:
    """A line whose runs are means over the scenes `common`, one per seed that has all of them."""
    by_seed: dict[int, list[Run]] = {}
    by_scene: dict[str, list[Run]] = {}
    for each in sorted(outcomes, key=lambda each: each.job.scene not in common):
        if each.run:
            by_scene.setdefault(each.job.scene, []).append(each.run)
            if each.job.scene in common:
                by_seed.setdefault(each.job.config.seed, []).append(each.run)
    runs = [over_scenes(of_seed) for of_seed in by_seed.values() if len(of_seed) == len(common)]
    gaps = list(_gaps(outcomes))
    if by_scene and not common:
        gaps.append("no scene that all lines have")
    several = {each.job.scene for each in outcomes} != {""}
    return Repeated(label, runs, gaps, by_scene if several else {})


def _gaps(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Each reason for gaps once, with its seeds and scenes unless it concerns all of them."""
    seeds = {each.job.config.seed for each in outcomes}
    scenes = {each.job.scene for each in outcomes}
    for why in dict.fromkeys(each.gap for each in outcomes if each.gap):
        where: dict[int, list[str]] = {}
        for each in outcomes:
            if each.gap == why:
                where.setdefault(each.job.config.seed, []).append(each.job.scene)
        groups = list(where.items())
        same = where.keys() == seeds and all(of == groups[0][1] for _, of in groups)
        for seed, of_seed in groups[:1] if same else groups:
            words = [] if same else [f"seed {seed}"]
            words += [] if len(of_seed) == len(scenes) else [", ".join(of_seed)]
            yield " ".join((*words, why))
