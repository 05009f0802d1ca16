"""Reads the tables that experiments declare: their lines, what the paper says of them, their grid.

A table is an experiment with a section `table`, in our folder or in one that `--config-dir` names.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

from bench.errors import SteerbenchError, unexpected, unknown
from bench.kinds import Words
from bench.records import without
from reports.claims import Claim, by_ratio
from reports.comparison import shown_as
from reports.paper_tables import METHOD, Line, PaperTable
from sweeps.configured import check_settings
from sweeps.data_sets import DATA_SETS, FIRST
from sweeps.experiments import SEED, experiment, grid
from sweeps.overrides import choices, setting


def chosen(
    name: str | None = None,
    words: Words = (),
    methods: Sequence[str] = (),
    data_sets: Sequence[str] = (FIRST,),
) -> list[PaperTable]:
    """The table called `name`, or those of the paper, with the paper's figures on `data_sets`.

    `words` may name folders with further tables. `methods` get a line each in tables that compare
    methods. SteerbenchError if there is no such table, or what is declared of it is wrong.
    """
    if name is not None:
        try:
            tables = [_table(name, experiment(name, words), data_sets)]
        except (AttributeError, LookupError, TypeError, ValueError, ZeroDivisionError) as error:
            expected = "fields as in docs/extending.md"
            raise unexpected(f"experiment {name}: table", expected, repr(error)) from error
    else:
        found = {name: experiment(name) for name in choices("experiment")}
        every = [_table(*each, data_sets) for each in found.items() if "table" in each[1]]
        tables = [table for table in every if table.number is not None]
        tables.sort(key=lambda table: table.number or 0)
    compared = [x for x in tables if any(METHOD in line.job for line in x.lines.values())]
    if methods and not compared:
        raise SteerbenchError(f"--beside: {name} compares no methods; table1 does")
    further = {f"with {x}": Line(x, {METHOD: x}, added=True) for x in methods}
    return [
        replace(table, lines={**table.lines, **further}) if table in compared else table
        for table in tables
    ]


def _table(name: str, whole: Any, data_sets: Sequence[str]) -> PaperTable:
    """What an experiment declares below `table`, with the figures on those of `data_sets` that
    there are any of."""
    where, declared = f"experiment {name}: table", whole.get("table")
    if not isinstance(declared, dict):
        raise unexpected(where, "a section with title and metrics", declared)
    own = {**declared, "published_on": _by_data_set(declared.get("published_on", {}))}
    own["reference"] = str(own.get("reference", ""))  # a key may look like a number
    own["instead"] = {str(key): str(of) for key, of in own.get("instead", {}).items()}
    own["beside"] = [*map(str, own.get("beside", ()))]
    label, said, _ = own.pop("label", None), own.pop("lines", {}), own.pop("axis", None)
    check_settings(PaperTable, own, f"{where}.", ("name", "lines", "data_sets"))
    for metric in (*own["metrics"], *own.get("scenes", ())):
        shown_as(metric)  # refuses a name that is no metric
    said = {str(key): of or {} for key, of in said.items()}
    if any("published" in of for of in said.values()) and not own["published_on"]:
        raise unexpected(f"{where}.published_on", "what `published` was measured on", "nothing")
    own["lines"] = lines = {}
    for key, job in _jobs(said, label, grid(whole), where).items():
        of = {**job, **said.get(key, {}), "job": job["job"]}
        published = _by_data_set(of.pop("published", {}))
        check_settings(Line, of, f"{where}.lines.{key}.", ("published", "added"))
        figures = {x: _figures(of_one, own["metrics"], where) for x, of_one in published.items()}
        lines[key] = Line(**of, published=figures)
    own["claims"] = [_claim(of, lines, f"{where}.claims.") for of in own.get("claims", ())]
    for other in own["published_on"].keys() - DATA_SETS:
        raise unknown("data set", other, DATA_SETS)
    if len({line.label for line in lines.values()}) < len(lines):
        raise unexpected(f"{where}.label", "another for each line", label)
    named = (own["reference"], *own["instead"], *own["instead"].values(), *own["beside"])
    _refuse_unknown(filter(None, named), lines)
    shown = [data_set for data_set in data_sets if data_set in own["published_on"]]
    return PaperTable(name, data_sets=shown or [""], **own)


def _jobs(
    said: Mapping[str, Any], label: str | None, grid: Mapping[str, Sequence[str]], where: str
) -> dict[str, dict[str, Any]]:
    """The job and the label of each line by key: of lines for which a `job` is `said`; if for none,
    of each job of the grid, whose key is made of its values."""
    jobs = {
        key: {"label": key, "job": _words(of["job"])} for key, of in said.items() if "job" in of
    }
    axes = {name: values for name, values in grid.items() if name != SEED}
    if not jobs and not axes:
        raise unexpected(where, "settings in hydra.sweeper.params, or lines with a job", "neither")
    label = label or ", ".join(f"{name}={{}}" for name in axes)
    for values in () if jobs else product(*axes.values()):
        job = dict(zip(axes, values, strict=True))
        jobs[", ".join(values)] = {"label": label.format(*values), "job": job}
    _refuse_unknown(said, jobs)
    return jobs


def _words(job: Any) -> Any:
    """YAML's values as Hydra's words, but for what is wrong."""
    if not isinstance(job, Mapping) or any(isinstance(of, Mapping) for of in job.values()):
        return job
    texts = {x: setting("", of)[1:] if isinstance(of, str) else of for x, of in job.items()}
    return {x: "null" if of is None else str(of) for x, of in texts.items()}


def _figures(
    published: Sequence[float | None], metrics: Sequence[str], where: str
) -> dict[str, float]:
    """The figures of a line by metric, from a list with None for those that are not there."""
    if len(published) != len(metrics):
        expected = f"{len(metrics)} figures, one for each of metrics"
        raise unexpected(f"{where}.lines.published", expected, len(published))
    pairs = zip(metrics, published, strict=True)
    figures = {metric: float(figure) for metric, figure in pairs if figure is not None}
    return {**figures, "frame_ms": 1000 / figures["fps"]} if "fps" in figures else figures


def _claim(declared: Mapping[str, Any], lines: Mapping[str, Line], where: str) -> Claim:
    """A claim about lines that an experiment declares as `rising` or as `alike`."""
    own = without(declared, ("rising", "alike"))
    check_settings(Claim, own, where, ("lines", "alike"))
    shown_as(own["metric"])
    if by_ratio(own["metric"]) and float(own["margin"]) < 1:
        raise unexpected(f"{where}margin", "a ratio such as 1.1", own["margin"])
    keys = [str(key) for key in declared.get("rising") or declared.get("alike") or ()]
    said = re.findall(r"\{([^{}]+)\}", own.get("says", ""))
    _refuse_unknown([*keys, *filter(None, said)], lines)
    return Claim(lines=keys, alike="alike" in declared, **own)


def _by_data_set(declared: Any) -> Mapping[str, Any]:
    return declared if isinstance(declared, dict) else {FIRST: declared}


def _refuse_unknown(keys: Iterable[str], lines: Collection[str]) -> None:
    for key in keys:
        if key not in lines:
            raise unknown("line", key, lines)
