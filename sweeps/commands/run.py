"""`steerbench run`: measures one run, or a sweep, and prints its tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from bench.errors import reason
from bench.kinds import Words
from sweeps.hydra_runs import run_hydra

if TYPE_CHECKING:
    from reports.runs import Runs
    from sweeps.execute import Ended
    from sweeps.measurement import Job


def main(argv: Words) -> int:
    """Run what the overrides and flags in `argv` say.

    The table at the end lists all jobs of a sweep. Raises the error of a job, or SteerbenchError
    for a wrong setting.
    """
    words, form = _without_form(argv)
    ended, errors = run_hydra(words, lambda config, command: _alone(config, command, form))
    if ended:
        _finish(ended, form)
    if errors:
        raise errors[0]
    return 0


# These load torch, which --help and completion do not need.


def _alone(config: DictConfig, command: Words, form: str | None) -> None:
    """Obtain the run that `config` describes, print its tables, write the page it asks for."""
    from reports.runs import load_runs
    from sweeps.measurement import Job, obtain
    from sweeps.terminal import say_missing, show_run, write_page

    job = Job(config, command)
    (key,), fresh = obtain([job])
    (run,) = load_runs(job.store, [key])
    if form:
        _show([run], {}, form)
    else:
        facts = ("method", "scene", "trajectory", "resolution", "budget", "protocol")
        show_run(run, f"{', '.join(run.facts[list(facts)])}, seed {run.facts['seed']}")
    if not fresh:
        say_missing([run])
    write_page(config.report, job.store, [key])


def _finish(ended: Sequence[tuple[Job, Ended]], form: str | None) -> None:
    """Print one table of all jobs that have ended, and write the pages that they requested."""
    from reports.runs import grouped, load_runs
    from sweeps.terminal import say_missing, write_page

    def of(jobs: Sequence[tuple[Job, Ended]]) -> tuple[list[str], dict[str, str]]:
        """Keys of the runs, equal ones once, and reasons of failed jobs by name."""
        failed = {job.name: reason(end.error) for job, end in jobs if end.error}
        return list(dict.fromkeys(end.run for _, end in jobs if end.run)), failed

    store = ended[0][0].store
    keys, failed = of(ended)
    runs = load_runs(store, keys)
    _show(runs, failed, form)
    say_missing(runs)
    for report, some in grouped(ended, lambda each: each[0].config.report).items():
        write_page(report, store, *of(some))


def _show(runs: Runs, failed: Mapping[str, str], form: str | None) -> None:
    from reports.comparison import columns_of, comparison
    from reports.lines import as_lines, seedless
    from sweeps.terminal import note, show

    lines = as_lines(runs)
    for label in seedless(lines):
        note(
            f"{label}: all seeds have the same PSNR, so that the interval says nothing: is "
            "`seed: ${seed}` in the YAML of the method?"
        )
    first, *further = comparison(lines, failed)
    show(first, lines.frame(columns_of(lines)) if form else None, form)
    for table in () if form else further:
        show(table)


def _without_form(argv: Words) -> tuple[list[str], str | None]:
    """The words that are Hydra's, and the form of tables that --format asks for."""
    from sweeps.cli import TYPES, Parser

    parser = Parser(prog="steerbench run", add_help=False, allow_abbrev=False)
    parser.add_argument("--format", **TYPES["form"])
    options, words = parser.parse_known_args(argv)
    return words, options.format
