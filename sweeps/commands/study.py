"""`steerbench accuracy`, `parity`, `skips`, `breakdown` and `scaling`: the studies of methods.

The lines of a study are runs in the store, as those of a sweep; a study shows them in its own way.
"""

import argparse
import re
import shlex
from collections.abc import Iterator, Sequence

from bench.errors import unexpected
from bench.provenance import commit, machine
from reports.images import Part, Parts
from reports.publish import publish
from reports.runs import load_runs
from reports.studies import VIEWS, Measured, MeasuredLines, by_method
from reports.tables import Table
from sweeps.execute import divided, run_all
from sweeps.studies import StudyJob, jobs_of, subjects
from sweeps.terminal import note, say, show


def main(options: argparse.Namespace) -> int:
    """Measure what the store lacks of a study, print its tables and write its page; return 1 if a
    line failed that can run here."""
    study = options.command
    limit = getattr(options, "within", None)
    within = None if limit is None else decibels(limit)
    words, _ = divided(options.overrides)
    given = {name: getattr(options, name) for name in ("only", "trained") if name in options}
    found = subjects(study, words)
    jobs = list(jobs_of(study, found, given))
    ended = run_all(jobs, options.overrides)
    done = [(job.line, end.run) for job, end in zip(jobs, ended, strict=True) if end.run]
    runs = load_runs(jobs[0].store, (key for _, key in done))
    lines = [Measured.of(line, run) for (line, _), run in zip(done, runs, strict=True)]
    if not lines:
        return 1
    parts = list(VIEWS[study](lines))
    for part in parts:
        if isinstance(part, Table):
            show(part)
    if within is not None:
        for text in _recommended(lines, jobs, within):
            say(text)
    folder = options.report or jobs[0].outputs / study
    page = publish([*_page(options, parts)], folder, [line.run for line in lines])
    note(f"report: {page}")
    return int(any(each.failed for each in ended))


def _page(options: argparse.Namespace, parts: Sequence[Part]) -> Parts:
    typed = shlex.join(["steerbench", *options.typed])
    yield f"# {options.command.capitalize()}"
    yield f"```sh\n{typed}\n```\n\nCommit {commit()}, {machine()['cpu']}."
    for part in parts:
        if isinstance(part, Table):
            yield f"## {part.title}"
        yield part


def decibels(text: str) -> float:
    """The number in "0.1dB", "0.1 dB" or "0.1"; SteerbenchError if invalid or negative."""
    number = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(dB)?", text, re.IGNORECASE)
    if not number:
        raise unexpected("--within", "decibels, 0.1dB for example", repr(text))
    return float(number[1])


def _recommended(lines: MeasuredLines, jobs: Sequence[StudyJob], limit: float) -> Iterator[str]:
    """For each method, the fastest setting that loses at most `limit` dB, as a command."""
    commands = {job.line: job.command for job in jobs}
    for method, of_method in by_method(lines).items():
        first = of_method[0]
        allowed = [line for line in of_method if line.lost <= limit]
        if not allowed:  # the first is perfect
            label = first.line.label
            yield f"{method}: no setting, because {label!r} has an infinite PSNR"
            continue
        best = min(allowed, key=lambda line: (line.ms, line.lost))
        yield (
            f"{method}, within {limit:g} dB of {first.line.label}: {best.line.label}, "
            f"{best.ms:.1f} ms, {best.lost:.3f} dB lost\n{shlex.join(commands[best.line])}"
        )
