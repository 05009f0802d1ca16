"""The jobs of the tables of the paper."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import product
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.errors import SteerbenchError
from reports.paper_tables import METHOD, Line, PaperTable, paper_tables
from sweeps.build import build, target_of
from sweeps.data_sets import DataSet
from sweeps.device_lock import on_gpu
from sweeps.identity import described, job_key
from sweeps.names import unknown
from sweeps.overrides import CONFIGS, changed, choices, composed, setting, swept

TABLES = CONFIGS / "experiment"
"""The folder of the experiments that declare the tables."""

REPEATED = "seed"
"""The only setting that may have several values; a cell then shows mean and interval."""


@dataclass(frozen=True)
class Repeats:
    """How much of the tables is measured (`tables` in run.yaml).

    Attributes:
        seeds: every cell of the paper's method is repeated with this many seeds, starting at 0.
        beyond: whether tables that vary the training also cover the method beyond the paper.
    """

    seeds: int
    beyond: bool

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ValueError(f"seeds: expected 1 or more, got {self.seeds}")


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
    tables = {table.name: table for table in paper_tables(TABLES)}
    if name is not None and name not in tables:
        raise unknown("table", name, tables)
    wanted = [tables[name]] if name else list(tables.values())
    of_methods = [any(METHOD in line.job for line in table.lines) for table in wanted]
    if methods and not any(of_methods):
        raise SteerbenchError(f"--with: {name} compares no methods; table1 does")
    further = [Line(method, {METHOD: method}) for method in methods]
    return [
        replace(table, lines=[*table.lines, *further]) if compares else table
        for table, compares in zip(wanted, of_methods, strict=True)
    ]


def plan(table: PaperTable, words: Sequence[str], data: DataSet | None = None) -> list[Planned]:
    """The jobs of `table` under the settings in `words`, for each line, seed and scene of `data`.

    Seeds are those in `words`, otherwise the first `tables.seeds`; curves and methods other than
    the paper's use only one of them. Settings that a line lacks are those of the experiment. Lines
    at a precision that the engine lacks are left out. On a GPU the engine is torch, unless `words`
    choose another.

    Raises:
        SteerbenchError: a word cannot be read, names nothing, or gives several values to a setting
            other than the seed.
    """
    words, seeds = _seeds(words)
    fixed = [f"+experiment={table.name}", *words, *([f"scene={data.layout}"] if data else [])]
    experiment = composed(fixed)
    if on_gpu(str(experiment.get("device"))):
        fixed.insert(1, "engine=torch")  # Table 1 uses OpenVINO, which computes on a CPU
        experiment = composed(fixed)
    build(experiment, "budget")  # refuses a wrong one before anything runs
    repeats = build(experiment, "tables")
    engine = experiment.engine
    precisions = target_of(engine).precisions
    usual = [str(seed) for seed in range(repeats.seeds)]
    scenes = {name: str(folder) for name, folder in data.scenes.items()} if data else {"": ""}

    @cache  # values are set afterwards without composing again
    def with_choices(*groups: str) -> DictConfig:
        return composed([*fixed, *groups])

    jobs = []
    for block, line, repeated in _lines(table, repeats.beyond):
        if line.job.get("precision", engine.precision) not in precisions:
            continue
        settings = [f"{name}={value}" for name, value in line.job.items()]
        groups = [word for word in settings if choices(word.partition("=")[0], fixed)]
        values = [word for word in settings if word not in groups]
        of_line = seeds or (usual if repeated else usual[:1])
        for seed, (scene, folder) in product(of_line, scenes.items()):
            word = f"{REPEATED}={seed}"
            job = changed(with_choices(*groups), [*values, word])
            place = []
            if data:
                job.scene.path = folder
                place = [setting("scene.path", folder)]
            OmegaConf.resolve(job)  # once, or each build would resolve `${...}` again
            command = ["steerbench", "run", *fixed, *settings, *place, word, "hydra.mode=RUN"]
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
        yield from ((block.title, line, METHOD not in line.job) for line in block.lines)
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
