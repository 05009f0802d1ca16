"""Reads the tables that experiments declare: their lines, what the paper says of them, their grid.

A table is an experiment with a section `table`, in our folder or in one that `--config-dir` names.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from string import Formatter
from typing import Any

from omegaconf import OmegaConf

from bench.errors import SteerbenchError, unexpected, unknown
from bench.study import Axis
from reports.claims import Claim
from reports.comparison import shown_as
from reports.paper_tables import METHOD, Block, Line, PaperTable
from sweeps.configured import check_settings
from sweeps.data_sets import FIRST
from sweeps.overrides import choices, swept

SEED = "seed"  # in a grid, it makes no lines: they are means over their seeds

OF_LINES = ("lines", "label", "axis", "published_on", "beside")
"""What a table declares of its lines; all else are attributes of a `PaperTable`."""


def chosen(
    name: str | None = None,
    words: Sequence[str] = (),
    methods: Sequence[str] = (),
    data_sets: Sequence[str] = (FIRST,),
) -> list[PaperTable]:
    """The table called `name`, or those of the paper, with the paper's figures on `data_sets`.

    `words` may name folders with further tables. `methods` get a line each in tables that compare
    methods. SteerbenchError if there is no such table, or what is declared of it is wrong.
    """
    if name is not None:
        tables = [_table(name, _experiment(name, words), data_sets)]
    else:
        found = {name: _experiment(name) for name in choices("experiment")}
        every = [_table(*each, data_sets) for each in found.items() if "table" in each[1]]
        tables = [table for table in every if table.number is not None]
        tables.sort(key=lambda table: table.number or 0)
    compared = [any(METHOD in line.job for line in table.lines.values()) for table in tables]
    if methods and not any(compared):
        raise SteerbenchError(f"--with: {name} compares no methods; table1 does")
    further = {f"with {x}": Line(x, {METHOD: x}, added=True) for x in methods}
    for place in range(len(tables)) if methods else ():
        if compared[place]:
            first, *others = tables[place].blocks
            first = replace(first, lines={**first.lines, **further})
            tables[place] = replace(tables[place], blocks=[first, *others])
    return tables


def grid(name: str, words: Sequence[str] = ()) -> dict[str, list[str]]:
    """The settings that the experiment `name` varies, each with its values, as it declares them.

    `words` may name folders with further experiments.
    """
    return _grid(_experiment(name, words))


def axes(method: str) -> dict[str, Axis]:
    """The settings of `method`, whole numbers, that our tables vary, by the name of the axis."""
    found = {}
    for name in choices("experiment"):
        experiment = _experiment(name)
        table = experiment.get("table", {})
        if "axis" in table and {"override /method": method} in experiment["defaults"]:
            ((setting, values),) = _grid(experiment).items()
            found[table["axis"]] = Axis(table["label"], setting, tuple(sorted(map(int, values))))
    return found


def _experiment(name: str, words: Sequence[str] = ()) -> Any:
    """What the file of an experiment holds."""
    files = choices("experiment", words)
    if name not in files:
        raise unknown("table", name, files)
    return OmegaConf.to_container(OmegaConf.load(files[name]))


def _grid(experiment: Any) -> dict[str, list[str]]:
    params = experiment.get("hydra", {}).get("sweeper", {}).get("params", {})
    several = swept([f"{name}={values}" for name, values in params.items()])
    return {name: several.get(name, [str(values)]) for name, values in params.items()}


def _table(name: str, experiment: Any, data_sets: Sequence[str]) -> PaperTable:
    """What an experiment declares below `table`."""
    where, declared = f"experiment {name}: table", experiment.get("table")
    if not isinstance(declared, dict):
        raise unexpected(where, "a section with title and metrics", declared)
    own = {key: of for key, of in declared.items() if key not in OF_LINES}
    own["reference"] = str(own.get("reference", ""))  # a key may look like a number
    own["instead"] = {str(key): str(of) for key, of in own.get("instead", {}).items()}
    check_settings(PaperTable, own, f"{where}.", ("name", "blocks"))
    for metric in own["metrics"]:
        shown_as(metric)  # refuses a name that is no metric
    axes = {key: values for key, values in _grid(experiment).items() if key != SEED}
    lines = _lines(declared, axes, f"{where}.lines")
    own["claims"] = [_claim(of, lines, f"{where}.claims.") for of in own.get("claims", ())]
    beside = [str(key) for key in declared.get("beside", lines)]
    named = [own["reference"], *own["instead"], *own["instead"].values(), *beside]
    _refuse_unknown(filter(None, named), lines)
    return PaperTable(name, blocks=_blocks(declared, lines, beside, data_sets, where), **own)


def _lines(
    declared: Mapping[str, Any], grid: Mapping[str, Sequence[str]], where: str
) -> dict[str, Line]:
    """The lines of a table by key, without figures: those that are declared with a `job`; if none
    is, one for each job of the grid, whose key is made of its values."""
    said = {str(key): of or {} for key, of in declared.get("lines", {}).items()}
    jobs = {key: of["job"] for key, of in said.items() if "job" in of}
    labels = {key: key for key in jobs}
    if not jobs:
        if not grid:
            raise unexpected(where, "settings in hydra.sweeper.params, or lines with a job", "none")
        jobs = {
            ", ".join(job): dict(zip(grid, job, strict=True)) for job in product(*grid.values())
        }
        label = declared.get("label") or ", ".join(f"{name}={{}}" for name in grid)
        labels = {key: label.format(*job.values()) for key, job in jobs.items()}
    _refuse_unknown(said, jobs)
    lines = {}
    for key, job in jobs.items():
        job = {name: str(value) for name, value in job.items()}
        of = {"label": labels[key], **said.get(key, {}), "job": job}
        of.pop("published", None)
        check_settings(Line, of, f"{where}.{key}.", ("published", "added"))
        lines[key] = Line(**of)
    return lines


def _claim(declared: Mapping[str, Any], lines: Mapping[str, Line], where: str) -> Claim:
    """A claim about lines that an experiment declares as `rising` or as `alike`."""
    own = {name: of for name, of in declared.items() if name not in ("rising", "alike")}
    check_settings(Claim, own, where, ("lines", "alike"))
    shown_as(own["metric"])
    keys = [str(key) for key in declared.get("rising") or declared.get("alike") or ()]
    said = (key for _, key, _, _ in Formatter().parse(own.get("says", "")))
    _refuse_unknown([*keys, *filter(None, said)], lines)
    return Claim(lines=keys, alike="alike" in declared, **own)


def _blocks(
    declared: Mapping[str, Any],
    lines: Mapping[str, Line],
    beside: Sequence[str],
    data_sets: Sequence[str],
    where: str,
) -> list[Block]:
    """A block for each of `data_sets` that there are figures of, of the first with all lines."""
    figures = {
        str(key): _by_data_set(of["published"])
        for key, of in declared.get("lines", {}).items()
        if of and "published" in of
    }
    published_on = _by_data_set(declared.get("published_on", {}))
    if figures and not published_on:
        raise unexpected(f"{where}.published_on", "what `published` was measured on", "nothing")
    blocks: list[Block] = []
    for data_set in [name for name in data_sets if name in published_on] or [""]:
        shown = {
            key: replace(
                lines[key],
                published=_figures(figures.get(key, {}).get(data_set), declared["metrics"], where),
            )
            for key in (beside if blocks else lines)
        }
        blocks.append(Block(shown, data_set, published_on.get(data_set, "")))
    return blocks


def _figures(
    published: Sequence[float | None] | None, metrics: Sequence[str], where: str
) -> dict[str, float]:
    """Figures in the order of `metrics` by metric; those that are not there are None."""
    if published and len(published) != len(metrics):
        expected = f"{len(metrics)} figures, one for each of metrics"
        raise unexpected(f"{where}.lines.published", expected, len(published))
    pairs = zip(metrics, published or (), strict=False)
    figures = {metric: figure for metric, figure in pairs if figure is not None}
    if "fps" in figures:
        figures["frame_ms"] = 1000 / figures["fps"]
    return figures


def _by_data_set(declared: Any) -> Mapping[str, Any]:
    return declared if isinstance(declared, dict) else {FIRST: declared}


def _refuse_unknown(keys: Iterable[str], lines: Collection[str]) -> None:
    for key in keys:
        if key not in lines:
            raise unknown("line", key, lines)
