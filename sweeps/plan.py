"""The jobs of the tables of the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from reports.paper_tables import AFTER, METHOD, OF_CURVES, Line, PaperTable, paper_tables
from sweeps.build import build, target_of
from sweeps.data_sets import DataSet
from sweeps.device_lock import on_gpu
from sweeps.identity import described, job_key
from sweeps.names import unknown
from sweeps.overrides import changed, choices, composed, setting, swept

REPEATED = "seed"
"""The only setting that may have several values; a cell then shows mean and interval."""


@dataclass(frozen=True)
class Planned:
    """A job: the line of a table that it fills, its configuration, and the command that runs it.

    `block` is the title of the group of lines that it is compared with. `scene` is its scene in a
    data set, empty without a data set. Jobs with the same `turns` are measured in turns; if it is
    empty, the job is measured alone.
    """

    table: str
    block: str
    line: str
    config: DictConfig
    command: Sequence[str]
    scene: str = ""
    turns: str = ""

    @property
    def name(self) -> str:
        """The name of the job at the terminal."""
        parts = (f"{self.table}: {self.line}", self.scene, f"seed {self.config.seed}")
        return ", ".join(filter(None, parts))

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The settings that determine its run."""
        return described(self.config)

    @cached_property
    def key(self) -> str:
        """Equal for equal jobs."""
        return job_key(self.settings, self.turns)


def chosen(name: str | None, methods: Sequence[str]) -> list[PaperTable]:
    """The table called `name`, or all of them; `methods` get extra lines in the table of methods.

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


def plan(table: PaperTable, words: Sequence[str], data: DataSet | None = None) -> list[Planned]:
    """The jobs of the experiment of `table` under the settings in `words`.

    One for each line that has a job, each seed, and each scene of `data`. Seeds are those in
    `words`, otherwise those of the budget; curves and methods other than the paper's then use only
    the first one.

    Settings that a line does not give are those of the experiment. Jobs of the sweep that no line
    names are left out (Instant-NGP has no 2D renderer to compute in int8), and so are lines at a
    precision that the engine lacks. On a GPU the engine is torch, unless `words` choose another.

    Raises:
        SteerbenchError: a word cannot be read, names nothing, or gives several values to a setting
            other than the seed; or the experiment does not have the job that a line asks for.
    """
    fixed, seeds = _seeds(words)
    fixed += [f"scene={data.layout}"] if data else []
    scenes = {name: str(folder) for name, folder in data.scenes.items()} if data else {"": ""}
    experiment = composed([f"+experiment={table.name}", *fixed], return_hydra_config=True)
    if on_gpu(str(experiment.get("device"))):
        fixed = ["engine=torch", *fixed]  # Table 1 uses OpenVINO, which computes on a CPU
        experiment = composed([f"+experiment={table.name}", *fixed], return_hydra_config=True)
    engine = experiment.engine
    precisions = target_of(engine).precisions
    budget = build(experiment, "budget")
    usual = [str(seed) for seed in range(budget.seeds)]
    params = experiment.hydra.sweeper.params
    grid = swept([f"{name}={values}" for name, values in params.items()])

    @cache  # values are set afterwards without composing again
    def with_choices(*groups: str) -> DictConfig:
        return composed([f"+experiment={table.name}", *fixed, *groups])

    besides = {AFTER, *OF_CURVES}  # settings of curves, which are in no experiment
    jobs = []
    for block, line, repeated in _lines(table, budget.beyond):
        if line.job is None or line.job.get("precision", engine.precision) not in precisions:
            continue
        added = line.job == {METHOD: line.label}
        swept_here = {name: value for name, value in line.job.items() if name not in besides}
        if not added and any(value not in grid.get(name, ()) for name, value in swept_here.items()):
            there = "; ".join(f"{name}={','.join(some)}" for name, some in grid.items())
            raise SteerbenchError(
                f"{table.name}: no job of its experiment fills the line {line.label!r}; expected "
                f"the settings of its job among {there}"
            )
        settings = [f"{name}={value}" for name, value in line.job.items()]
        groups = [word for word in settings if choices(word.partition("=")[0], fixed)]
        config = with_choices(*groups)
        values = [word for word in settings if word not in groups]
        of_line = seeds or (usual if repeated else usual[:1])
        for seed, (scene, folder) in product(of_line, scenes.items()):
            word = f"{REPEATED}={seed}"
            job = changed(config, [*values, word])
            if data:
                job.scene.path = folder
            OmegaConf.resolve(job)  # once, or each build would resolve `${...}` again
            place = [setting("scene.path", folder)] if data else []
            given = [f"+experiment={table.name}", *fixed, *settings, *place, word]
            command = ["steerbench", "run", *given, "hydra.mode=RUN"]
            turns = f"{table.name}, {block}, {seed}, {scene}" if table.in_turns else ""
            jobs.append(Planned(table.name, block, line.label, job, command, scene, turns))
    return jobs


def _lines(table: PaperTable, beyond: bool) -> Iterator[tuple[str, Line, bool]]:
    """The lines of a table's blocks and curves, each with its block's title and whether it repeats.

    Only lines of the paper's method are repeated with several seeds, because the paper's
    conclusions are about it. A table that varies the training omits the method beyond the paper
    unless `beyond`.
    """
    for block in table.blocks if beyond or not table.curve else [table]:
        yield from ((block.title, line, METHOD not in (line.job or {})) for line in block.lines)
    yield from (("curves", line, False) for line in table.marks.values())


def _seeds(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words that all jobs share, and the seeds given by the other words."""
    several = swept(words)
    if others := sorted(several.keys() - {REPEATED}):
        raise SteerbenchError(
            f"{others[0]}: expected one value, got {', '.join(several[others[0]])}; only "
            f"{REPEATED} may take several here"
        )
    named = [word for word in words if word.lstrip("+").partition("=")[0] == REPEATED]
    values = several.get(REPEATED) or [word.partition("=")[2] for word in named[-1:]]
    return [word for word in words if word not in named], list(dict.fromkeys(values))
