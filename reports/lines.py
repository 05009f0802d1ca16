"""Runs as lines of a table: seeds are repetitions, and settings that differ are columns."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import pandas as pd

from bench.kinds import Say
from bench.results import COLUMNS, Store, content_key
from reports.runs import (
    Repeated,
    Run,
    Runs,
    TableLines,
    grouped,
    over_common_frames,
    readable,
    unseeded,
)
from reports.tables import QUALITY

METHOD = "method"  # the first column

Settings = Mapping[str, Sequence[str]]  # the value of each line, by setting

COMMON = ("scene", "resolution", "trajectory", "budget", "protocol", "device")
"""Facts that a heading lists."""

FACTS = (*COMMON, "engine", "precision")
"""Columns of rows that are shown where they differ, beside the method."""

HIDDEN = ("pictures", "budget.name", "protocol.name", "scene.name")
"""Settings that make no column: what changes no figure, and what `FACTS` show."""

TAKEN = (METHOD, "seeds", "frames", "frame_ms", "fps", "train_s", *QUALITY)
"""Columns of our own, which no setting is shortened to."""

LOGARITHM = "log2_"  # begins the names of settings that are exponents of 2


@dataclass(frozen=True)
class Lines:
    """`runs` that differ only in their seed make one of `lines`, in the order of the first of them.

    `settings` are the columns before the figures: the method, then what differs between the lines,
    with the value of each line.
    """

    lines: TableLines
    settings: Settings

    @property
    def runs(self) -> list[Run]:
        return [run for line in self.lines for run in line.runs]

    def frame(self, metrics: Sequence[str]) -> pd.DataFrame:
        """A row each: settings, number of seeds, means of metrics and halves of their intervals."""
        figures: dict[str, Sequence[Any]] = {
            **self.settings,
            "seeds": [len(line.runs) for line in self.lines],
        }
        for metric in metrics:
            figures[metric] = [line.mean(metric) for line in self.lines]
            figures[f"{metric}.half"] = [line.half(metric) for line in self.lines]
        return pd.DataFrame(figures)


def as_lines(runs: Runs) -> Lines:
    """The lines of `runs`, over the frames that are steady in all of them.

    The label of a run is shown as its method.
    """
    by_line = grouped(over_common_frames(runs), _line_of)
    by_seed = ({run.facts["seed"]: run for run in of_line} for of_line in by_line.values())
    groups = [[*of_line.values()] for of_line in by_seed]  # a seed counts once
    firsts = [of_line[0] for of_line in groups]
    settings = {METHOD: [run.label for run in firsts], **differing(firsts)}
    machines = [", ".join(run.computer) for run in firsts]
    if not _follows(list(settings.values()), machines):
        settings["machine"] = machines
    columns = list(settings.items())
    lines = []
    for index, of_line in enumerate(groups):
        method = settings[METHOD][index]
        own = [f"{name}={of[index]}" for name, of in columns[1:] if of[index] not in ("", "none")]
        if settings[METHOD].count(method) == 1:
            own = []
        several = len(set(settings[METHOD])) > 1
        lines.append(Repeated(", ".join([method, *own] if several or not own else own), of_line))
    return Lines(lines, settings)


def seedless(lines: Lines) -> list[str]:
    """The lines whose seeds all have one quality: they ignore their seed, so that an interval over
    seeds says nothing."""
    found: list[str] = []
    for line in lines.lines:
        qualities = {run.values.get("psnr") for run in line.runs}
        if len(line.runs) > 1 and len(qualities) == 1 and None not in qualities:
            found.append(line.label)
    return found


def differing(runs: Runs) -> dict[str, list[str]]:
    """What `varied` finds, under short names: the symbol of the paper, or the last part."""
    columns = varied(runs)
    symbols = {name: of for run in runs for name, of in run.record.get("axes", {}).items()}
    short = shortened(list(columns)) | symbols
    return {short[name]: values for name, values in columns.items()}


def shortened(names: Sequence[str]) -> dict[str, str]:
    """The last part of each of the `names` of settings or, if several columns end so, all of it."""
    ends = [*(name.rpartition(".")[2] for name in names), *TAKEN]
    return {
        name: end if ends.count(end) == 1 else name for name, end in zip(names, ends, strict=False)
    }


def varied(runs: Runs) -> dict[str, list[str]]:
    """The facts and the settings beside method and seed that differ between `runs`, with their
    values.

    Settings of a method are compared with those under the same label. One that follows from columns
    that are shown already is left out, unless it was typed.
    """
    columns = {
        fact: values
        for fact in FACTS
        if len(set(values := [str(run.facts[fact]) for run in runs])) > 1
    }
    methods = [run.label for run in runs]
    settings = pd.DataFrame([_settings(run) for run in runs]).fillna("")
    typed = dict.fromkeys(word for run in runs for word in _typed(run))
    for name in dict.fromkeys((*(name for name in typed if name in settings), *settings)):
        values = settings[name].tolist()
        shown = columns if name not in typed or name.partition(".")[0] in columns else {}
        if not _follows([methods, *shown.values()], values):
            columns[name] = values
    return columns


def results(store: Store, report: Say = lambda line: None) -> pd.DataFrame:
    """Every row of all runs, with a column for each setting that differs between them and, where
    runs differ in no setting, one with the commits and the time of each.

    `report` gets a line on those that cannot be read, for each reason.
    """
    runs = readable(store, report=report)
    if not runs:
        return store.rows()
    differ = pd.DataFrame(varied(runs), index=[run.key for run in runs])
    own = differ.drop(columns=[*FACTS, *COLUMNS], errors="ignore")
    jobs = {(_line_of(run), run.facts["seed"]) for run in runs}
    if len(jobs) < len(runs):
        own["version"] = [f"{run.commit}, {_when(run)}" for run in runs]
    return pd.concat([run.rows for run in runs], ignore_index=True).join(own, on="run")


def _when(run: Run) -> str:
    """When a run was stored, to the minute, in local time."""
    return f"{datetime.fromtimestamp(run.record['stored']):%Y-%m-%d %H:%M}"


def _follows(known: Sequence[Sequence[str]], values: Sequence[str]) -> bool:
    """Whether runs with the same values of all `known` columns have the same of `values`."""
    places = list(zip(*known, strict=True))
    return len(set(zip(places, values, strict=True))) == len(set(places))


def _line_of(run: Run) -> str:
    """Equal for runs that differ only in their seed."""
    if "config" not in run.record["made_of"]:
        return run.key
    return content_key({"settings": _settings(run), "where": list(map(str, run.conditions))})


def _settings(run: Run) -> dict[str, str]:
    """The settings of a run by name, without seeds, as text; none for scored pictures."""
    config = run.config
    return {name: _text(name, of) for name, of in unseeded(config) if name not in HIDDEN}


def _text(name: str, value: Any) -> str:
    if value is None:
        return "null"
    return f"2^{value}" if name.rpartition(".")[2].startswith(LOGARITHM) else str(value)


def _typed(run: Run) -> list[str]:
    """The names of the settings that were typed for a run."""
    words = shlex.split(run.command)
    return [word.lstrip("+").partition("=")[0] for word in words if "=" in word]
