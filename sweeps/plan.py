"""What there is to measure for the tables of the paper, and what of it is there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import cast

from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from bench.results import Store, content_key
from reports.paper_tables import PaperTable, paper_tables
from reports.runs import Repeated, Run, readable
from sweeps import failures
from sweeps.measurement import described, of_scene
from sweeps.names import unknown
from sweeps.overrides import composed, swept

REPEATED = "seed"
"""The one setting that may take several values: a cell then has a mean and an interval."""


@dataclass(frozen=True)
class Planned:
    """A job: the line of a table that it fills, with which seed, and its whole configuration."""

    table: str
    line: str
    config: DictConfig
    command: Sequence[str]

    @property
    def name(self) -> str:
        """What it is called while it runs."""
        return f"{self.table}: {self.line}, seed {self.config.seed}"

    @cached_property
    def key(self) -> str:
        """The same for jobs that are the same."""
        return content_key(described(self.config))


def chosen(name: str | None) -> list[PaperTable]:
    """The table called `name`; all of them without one."""
    tables = {table.name: table for table in paper_tables()}
    if name is not None and name not in tables:
        raise unknown("table", name, tables)
    return [tables[name]] if name else list(tables.values())


def plan(table: PaperTable, overrides: Sequence[str]) -> list[Planned]:
    """The jobs of the experiment of `table` under `overrides`, once for each of their seeds.

    What the experiment sweeps over and fills no line is left out: Instant-NGP has no 2D renderer to
    compute in int8.

    Raises:
        SteerbenchError: an override cannot be read, names nothing, or is swept and no seed; or a
            line asks for a job that the experiment does not have.
    """
    fixed, seeds = _seeds(overrides)
    lines = {
        frozenset(f"{name}={value}" for name, value in line.job.items()): line.label
        for line in table.lines
        if line.job
    }
    experiment = composed([f"+experiment={table.name}", *fixed], return_hydra_config=True)
    params = experiment.hydra.sweeper.params
    grid = swept([f"{name}={values}" for name, values in params.items()])
    jobs = []
    for values in product(*grid.values()):
        settings = [f"{name}={value}" for name, value in zip(grid, values, strict=True)]
        label = lines.get(frozenset(settings))
        if label is not None:
            together = [f"+experiment={table.name}", *fixed, *settings]
            config = composed(together)
            for seed in seeds:
                command = ["steerbench", "run", *together, *seed, "hydra.mode=RUN"]
                merged = OmegaConf.merge(config, OmegaConf.from_dotlist(seed))
                jobs.append(Planned(table.name, label, cast(DictConfig, merged), command))
    made = {job.line for job in jobs}
    if lost := [label for label in lines.values() if label not in made]:
        choices = "; ".join(f"{name}={','.join(some)}" for name, some in grid.items())
        raise SteerbenchError(
            f"{table.name}: no job of its experiment fills the line {lost[0]!r}; expected the "
            f"settings of its job among {choices}"
        )
    return jobs


def _seeds(overrides: Sequence[str]) -> tuple[list[str], list[list[str]]]:
    """Overrides that all jobs share, and those of each repetition."""
    several = swept(overrides)
    if others := sorted(several.keys() - {REPEATED}):
        raise SteerbenchError(
            f"{others[0]}: expected one value, got {', '.join(several[others[0]])}; only "
            f"{REPEATED} may take several here"
        )
    fixed = [text for text in overrides if REPEATED not in swept([text])]
    values = dict.fromkeys(several.get(REPEATED, ()))
    return fixed, [[f"{REPEATED}={value}"] for value in values] or [[]]


def newest(store: Store) -> dict[str, list[Run]]:
    """The runs of the store by the key of their job, one for each scene that has its settings: that
    which was stored last, and the last of these first."""
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
    """What there is of every line, by table: its runs, and why others are missing.

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
