"""The jobs of the tables of the paper, and their results as far as the store has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from bench.results import Store, content_key
from reports.paper_tables import METHOD, Line, PaperTable, paper_tables
from reports.runs import Repeated, Run, readable
from sweeps import failures
from sweeps.build import build
from sweeps.measurement import described, of_scene
from sweeps.names import unknown
from sweeps.overrides import composed, swept

REPEATED = "seed"
"""The one setting that may have several values: a cell then has a mean and an interval."""


@dataclass(frozen=True)
class Planned:
    """A job: the line of a table that it fills, its configuration, and the command that runs it."""

    table: str
    line: str
    config: DictConfig
    command: Sequence[str]

    @property
    def name(self) -> str:
        """The name of the job at the terminal."""
        return f"{self.table}: {self.line}, seed {self.config.seed}"

    @cached_property
    def key(self) -> str:
        """Equal for equal jobs."""
        return content_key(described(self.config))


def chosen(name: str | None, methods: Sequence[str]) -> list[PaperTable]:
    """The table called `name`, all of them without one; the table of methods has a line more for
    each of `methods`.

    Raises:
        SteerbenchError: there is no such table, or it compares no methods.
    """
    tables = {table.name: table for table in paper_tables()}
    if name is not None and name not in tables:
        raise unknown("table", name, tables)
    further = [Line(method, {METHOD: method}) for method in methods]
    found = []
    for table in [tables[name]] if name else tables.values():
        of_methods = any(METHOD in line.job for line in table.lines if line.job)
        lines = [*table.lines, *further] if of_methods else table.lines
        found.append(replace(table, lines=lines))
    if methods and name and found[0].lines == tables[name].lines:
        raise SteerbenchError(f"--with: {name} compares no methods; table1 does")
    return found


def plan(table: PaperTable, words: Sequence[str]) -> list[Planned]:
    """The jobs of the experiment of `table` under the settings in `words`: one for each line that
    has a job, and for each seed: those in `words`, or as many as the budget says.

    What a line does not set is as the experiment has it. A job of the sweep that no line names is
    left out: Instant-NGP has no 2D renderer to compute in int8.

    Raises:
        SteerbenchError: a word cannot be read, names nothing, or gives several values to another
            setting than the seed; or a line asks for a job that the experiment does not have.
    """
    fixed, seeds = _seeds(words)
    experiment = composed([f"+experiment={table.name}", *fixed], return_hydra_config=True)
    seeds = seeds or [str(seed) for seed in range(build(experiment, "budget").seeds)]
    params = experiment.hydra.sweeper.params
    grid = swept([f"{name}={values}" for name, values in params.items()])
    jobs = []
    for line in (line for block in table.blocks for line in block.lines):
        if line.job is None:
            continue
        added = line.job == {METHOD: line.label}
        if not added and any(value not in grid.get(name, ()) for name, value in line.job.items()):
            choices = "; ".join(f"{name}={','.join(some)}" for name, some in grid.items())
            raise SteerbenchError(
                f"{table.name}: no job of its experiment fills the line {line.label!r}; expected "
                f"the settings of its job among {choices}"
            )
        settings = [f"{name}={value}" for name, value in line.job.items()]
        together = [f"+experiment={table.name}", *fixed, *settings]
        config = composed(together)
        for seed in seeds:
            word = f"{REPEATED}={seed}"
            command = ["steerbench", "run", *together, word, "hydra.mode=RUN"]
            merged = OmegaConf.merge(config, OmegaConf.from_dotlist([word]))
            jobs.append(Planned(table.name, line.label, cast(DictConfig, merged), command))
    return jobs


def _seeds(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words that all jobs share, and the seeds that the others name, if any does."""
    several = swept(words)
    if others := sorted(several.keys() - {REPEATED}):
        raise SteerbenchError(
            f"{others[0]}: expected one value, got {', '.join(several[others[0]])}; only "
            f"{REPEATED} may take several here"
        )
    named = [word for word in words if word.lstrip("+").partition("=")[0] == REPEATED]
    values = several.get(REPEATED) or [word.partition("=")[2] for word in named[-1:]]
    return [word for word in words if word not in named], list(dict.fromkeys(values))


def newest(store: Store) -> dict[str, list[Run]]:
    """The runs of the store by the key of their job, the newest first: of each scene that has the
    settings of the job, the run that was stored last."""
    found: dict[str, dict[str, Run]] = {}
    for run in reversed(readable(store)):
        parts = run.record["made_of"]
        if "config" in parts:
            of_job = found.setdefault(content_key(parts["config"]), {})
            of_job.setdefault(run.record["scene"]["digest"], run)
    return {job: list(of_scenes.values()) for job, of_scenes in found.items()}


def gather(
    jobs: Sequence[Planned], runs: Mapping[str, Sequence[Run]], outputs: Path
) -> dict[str, list[Repeated]]:
    """The lines of every table: the runs of each, and why others are missing.

    Args:
        runs: as `newest` has them.
    """
    lines: dict[tuple[str, str], list[Planned]] = {}
    for job in jobs:
        lines.setdefault((job.table, job.line), []).append(job)
    tables: dict[str, list[Repeated]] = {}
    for (table, label), same in lines.items():
        found, gaps = [], []
        for job in same:
            failure = failures.found(outputs, described(job.config))
            shown = (run for run in runs.get(job.key, ()) if of_scene(run, job.config))
            if run := next(shown, None):
                found.append(replace(run, label=label))
                why = failure and f"failed when it was tried again: {failure}"
            else:
                why = f"failed: {failure}" if failure else "not measured yet"
            if why:
                gaps.append(f"seed {job.config.seed} {why}" if len(same) > 1 else why)
        tables.setdefault(table, []).append(Repeated(label, found, gaps))
    return tables
