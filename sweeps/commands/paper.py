"""`steerbench paper` measures the tables of the SteerNeRF paper, or another, and writes a page of
them; `steerbench report` writes the same page from the store alone."""

import argparse
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from bench.errors import SteerbenchError, some
from bench.kinds import Words
from bench.results import Store, existing_store
from reports import export
from reports.paper_page import write_paper_page
from reports.paper_tables import Place
from reports.runs import Repeated, Run, Runs, grouped, over_common_frames, over_scenes
from sweeps.data_sets import DataSet, data_sets, find
from sweeps.execute import divided, run_all
from sweeps.measurement import of_scene
from sweeps.overrides import unquoted
from sweeps.plan import Planned, plan, scenes_of
from sweeps.tables import chosen
from sweeps.terminal import note
from sweeps.versions import by_job, is_present

DATA = "data="  # prefix of the word that names the folder of a data set


def main(options: argparse.Namespace) -> int:
    """Measure what the store lacks (unless only a report is wanted) and write the page.

    Returns 1 if a job failed that can run here.
    """
    settings, _ = divided(options.overrides)
    words, data = data_set(settings)
    missing = data.missing if data else {}
    for name, why in missing.items():
        note(f"missing: {name}: {why}")
    shown = data_sets(scenes_of(words, data))
    one = getattr(options, "table", None)
    tables = chosen(one, words, options.beside, shown)
    jobs = [job for table in tables for job in plan(table, words, data)]
    outputs = jobs[0].outputs
    ended = [] if options.command == "report" else run_all(jobs, options.overrides)
    store = existing_store(outputs) if options.command == "report" else Store(outputs)
    runs = by_job(store, note)
    folder = options.report or outputs / (one or "paper")
    measured = gather(jobs, runs)
    of_lines = {run.key: run for line in measured.values() for run in line.measured}
    if stale := [key for key, run in of_lines.items() if not is_present(run)]:
        note(f"of other code than is here now: {some(stale)}")
    page = write_paper_page(tables, measured, folder, missing)
    if options.format or options.command == "table":
        print(export.exported_tables(tables, measured, options.format or "markdown"), end="")
    note(f"report: {page}")
    return int(any(each.failed for each in ended))


def data_set(words: Words) -> tuple[list[str], DataSet | None]:
    """The settings among `words`, and the data set if one of them names it (data=DIR).

    SteerbenchError if another word names a scene, or the data set has no scenes.
    """
    settings = [word for word in words if not word.startswith(DATA)]
    named = [word for word in words if word.startswith(DATA)]
    of_scene = re.compile(r"[+~]*scene(\.path)?(=|$)")
    if named and (scenes := [word for word in settings if of_scene.match(word)]):
        both = f"{named[-1]} and {scenes[0]}"
        raise SteerbenchError(f"{both}: expected one of them; data names all scenes")
    return settings, find(unquoted(named[-1].removeprefix(DATA))) if named else None


class Outcome(NamedTuple):
    """A job with its run, if there is one, and the reason why it is missing or in doubt."""

    job: Planned
    run: Run | None
    gap: str | None


def gather(jobs: Sequence[Planned], runs: Mapping[str, Runs]) -> dict[Place, Repeated]:
    """The line of every job, with its runs and the reasons why others are missing.

    With several scenes, a run of a line is the mean of one seed over the scenes that all lines of
    the block have. Lines without any measurement are ignored for this. `runs` are from `by_job`.
    """
    outcomes = [_outcome(job, runs.get(job.key, ())) for job in jobs]
    blocks = grouped(outcomes, lambda each: each.job.place[:2]).values()
    return {place: line for block in blocks for place, line in _lines(block).items()}


def _outcome(job: Planned, runs: Runs) -> Outcome:
    failure = job.failure
    run = next((run for run in runs if of_scene(run, job.config)), None)
    if failure and not (run and failure.unavailable):  # no earlier run stands for it
        return Outcome(job, None, f"failed: {failure.why}")
    if run:
        why = f"cannot run here: {failure.why}" if failure else None
        return Outcome(job, replace(run, label=job.label), why)
    return Outcome(job, None, "not measured yet")


def _lines(of_block: Sequence[Outcome]) -> dict[Place, Repeated]:
    runs = [each.run for each in of_block if each.run]
    comparable = iter(over_common_frames(runs))
    outcomes = [
        each._replace(run=next(comparable)) if each.run else each  # over the same frames
        for each in of_block
    ]
    lines = grouped(outcomes, lambda each: each.job.place)
    measured = [{each.job.scene for each in line if each.run} for line in lines.values()]
    common = set.intersection(*filter(None, measured)) if any(measured) else set()
    return {place: _line(of_line, common) for place, of_line in lines.items()}


def _line(outcomes: Sequence[Outcome], common: set[str]) -> Repeated:
    """A line whose runs are means over the scenes `common`, one per seed that has all of them."""
    label = outcomes[0].job.label
    found = [(each.job, each.run) for each in outcomes if each.run]
    found.sort(key=lambda pair: pair[0].scene not in common)
    by_scene = {
        scene: [run for _, run in of_scene]
        for scene, of_scene in grouped(found, lambda pair: pair[0].scene).items()
    }
    shared = (pair for pair in found if pair[0].scene in common)
    complete = [
        [run for _, run in of_seed]
        for of_seed in grouped(shared, lambda pair: pair[0].config.seed).values()
        if len(of_seed) == len(common)
    ]
    runs = [over_scenes(of_seed) for of_seed in complete]
    gaps = list(_gaps(outcomes))
    if by_scene and not common:
        gaps.append("no scene that all lines have")
    if {each.job.scene for each in outcomes} == {""}:
        return Repeated(label, runs, gaps)
    return Repeated(label, runs, gaps, by_scene, [run for of_seed in complete for run in of_seed])


def _gaps(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Each reason for gaps once, with its seeds and scenes unless it concerns all of them."""
    seeds = {each.job.config.seed for each in outcomes}
    scenes = {each.job.scene for each in outcomes}
    gaps = (each for each in outcomes if each.gap)
    for why, of_why in grouped(gaps, lambda each: each.gap).items():
        by_seed = grouped(of_why, lambda each: each.job.config.seed)
        groups = [
            (seed, [each.job.scene for each in of_seed])  # where it is the reason
            for seed, of_seed in by_seed.items()
        ]
        alike = all(of_seed == groups[0][1] for _, of_seed in groups)
        same = alike and by_seed.keys() == seeds
        for seed, of_seed in groups[:1] if same else groups:
            words = [] if same else [f"seed {seed}"]
            words += [] if len(of_seed) == len(scenes) else [", ".join(of_seed)]
            yield " ".join((*words, str(why)))
