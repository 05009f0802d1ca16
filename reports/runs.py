"""Runs of the store, with everything that tables and pages need from them."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pandas as pd
import torch

from bench.clock import OTHER
from bench.errors import SteerbenchError
from bench.kinds import Say
from bench.metrics import psnr
from bench.neighbours import Neighbours
from bench.records import Record
from bench.results import COLD, ROWS, STEADY, Store, content_key
from bench.rows import half_interval, phase_rows
from bench.scenes.images import contents, decode_bytes
from bench.sharing import check_sums
from bench.study import part_of
from reports.tables import phases, run_tables

T = TypeVar("T")
K = TypeVar("K")

STAGE = "stage_ms."  # prefix of the metrics of stages

FIGURES = ("metric", "unit", "phase", "value", "n", "lo", "hi")
"""The columns of rows that are not facts about the whole run."""


@dataclass(frozen=True)
class Run:
    """One run of the store, by its `key`; `label` is its name in a table or figure.

    `rows` has one metric per row. `read_frames` reads the frames on demand: few reports need them,
    and they are most of a run. `record` says what the figures mean and where they come from;
    `pictures` is the folder of ground truths, renderings and error maps.
    """

    key: str
    label: str
    rows: pd.DataFrame = field(repr=False)
    read_frames: Callable[[], pd.DataFrame] = field(repr=False)
    record: Mapping[str, Any] = field(repr=False)
    pictures: Path = field(repr=False)

    @property
    def frames(self) -> pd.DataFrame:
        return self.read_frames()

    @property
    def steady(self) -> pd.DataFrame:
        """Its steady frames, or all if none are."""
        steady = self.frames[self.frames["phase"] == STEADY]
        return steady if len(steady) else self.frames

    @cached_property
    def headline(self) -> pd.DataFrame:
        """One row per metric, for the steady frames, or the cold ones if there are no others."""
        steady = (self.rows["phase"] == STEADY).any()
        rows = self.rows[self.rows["phase"] != COLD] if steady else self.rows
        return rows.set_index("metric")

    @cached_property
    def values(self) -> Record:
        """Figures of the headline by metric."""
        return Record(self.headline["value"].items(), self.pictures.parent / ROWS)

    def figure(self, metric: str) -> float | None:
        """A figure of the headline; a stage includes its nested stages. None if there is none."""
        figures = [
            value
            for name, value in self.values.items()
            if name == metric or name.startswith(f"{metric}/")
        ]
        return math.fsum(figures) if figures else None

    @property
    def parts(self) -> dict[str, float]:
        """The mean ms of each part of a frame, as the method groups its stages, the rest last."""
        grouping: Mapping[str, str] = self.record.get("parts", {})
        found = dict.fromkeys((*grouping.values(), OTHER), 0.0)
        for metric, value in self.values.items():
            if metric.startswith(STAGE):
                part = part_of(metric.removeprefix(STAGE), grouping)
                found[part] = found.get(part, 0.0) + value
        found[OTHER] = found.pop(OTHER)
        return {part: ms for part, ms in found.items() if ms or part == OTHER}

    @property
    def cold(self) -> Run | None:
        """The run with the figures of its cold frames alone, if it has steady ones, too."""
        of_phases = [of_phase for _, of_phase in phases(self.rows)]
        if len(of_phases) < 2:
            return None
        return replace(self, rows=of_phases[1])

    def _repr_markdown_(self) -> str:
        """The run's tables, for display in a notebook."""
        tables = "\n\n".join(f"#### {x.title}\n\n{x.markdown()}" for x in run_tables(self.rows))
        return f"### {self.label}\n\n{tables}"

    @cached_property
    def facts(self) -> pd.Series:
        """The columns that are equal in all rows: method, scene, protocol, device and so on."""
        return self.rows.drop(columns=list(FIGURES), errors="ignore").iloc[0]

    @property
    def command(self) -> str:
        """What measures it again."""
        return str(self.record["command"])

    @property
    def config(self) -> Mapping[str, Any]:
        """Its settings; none of scored pictures."""
        return self.record["made_of"].get("config", {})

    @property
    def digest(self) -> str:
        """The digest of its scene."""
        return self.record["scene"]["digest"]

    @property
    def views(self) -> tuple[object, ...]:
        """Equal for runs that rendered the same frames of the same scene."""
        where = (self.facts["split"], self.facts["trajectory"], self.facts["resolution"])
        return (self.digest, *where, len(self.frames))

    @property
    def computer(self) -> tuple[str, ...]:
        """Equal for runs on the same device, kind of processor and number of threads."""
        machine = self.record["machine"]
        threads = f"{machine['threads']} threads"
        return (self.facts["device"], machine["cpu"], threads, *machine["gpus"])

    @property
    def conditions(self) -> tuple[object, ...]:
        """Equal for runs whose figures are comparable."""
        phase = self.headline["phase"].iloc[0]
        return (*self.views, phase, self.rules, *self.computer)

    @property
    def rules(self) -> str:
        """The protocol of a run by its name, and what else says which pixels are compared."""
        protocol = self.record.get("protocol", {})
        own = (protocol.get(name, "") for name in ("background", "mask"))
        return ", ".join((str(self.facts["protocol"]), *own))

    def psnr_to(self, other: Run) -> float:
        """Mean PSNR in dB between the pictures that both runs kept; inf if all are equal, nan if
        there are none."""
        kept = sorted(self.pictures.glob("*-rendered.png"))
        pairs = [(path, other.pictures / path.name) for path in kept]
        found = [
            psnr(*(torch.from_numpy(read_picture(path)) / 255 for path in pair))
            for pair in pairs
            if pair[1].exists()
        ]
        return float(np.mean(found)) if found else math.nan

    @property
    def provenance(self) -> dict[str, str]:
        """Where the figures come from, except the command and the settings."""
        machine, record, row = self.record["machine"], self.record, self.facts
        memory = f"{machine['memory_bytes'] / 2**30:.0f} GiB"
        by = "device", "backend", "engine", "precision", "field_precision"
        computed = {name: row[name] for name in by}
        seen = record.get("neighbours")  # none where nothing was timed here
        return {
            "run": self.key,
            "scene": f"{row['scene']}, digest {self.digest[:16]}",
            "frames": f"{row['trajectory']} at {row['resolution']}",
            "protocol": listed(record["protocol"]),
            "budget": listed(record["budget"]),
            "seed": str(row["seed"]),
            "commit": self.commit,
            "computed on": listed(computed),
            "times": record.get("times", "not recorded"),
            "doubts": "; ".join(record.get("doubts", ())) or "none",
            "peak memory": record["peak_bytes"],
            "machine": f"{machine['cpu']}, {machine['threads']} threads, {memory}",
            "beside it": str(Neighbours(**seen)) if seen else "not recorded",
            "GPU": ", ".join(machine["gpus"]) or "none",
            "system": f"{machine['system']}, Python {machine['python']}",
            "versions": listed(record["made_of"].get("libraries", {})),
        }

    @property
    def commit(self) -> str:
        """The commits of steerbench and of the checkouts that code of others lies in."""
        others = self.record.get("repositories", {})
        return ", ".join((self.facts["commit"], *(f"{top} {of}" for top, of in others.items())))

    @property
    def settings(self) -> dict[str, str]:
        """The settings of the method by the names that one types; none for scored pictures."""
        method = self.config.get("method", {})
        named = ((name, str(value)) for name, value in flat({"method": method}))
        return dict(pair for pair in named if "._" not in pair[0])  # Hydra's own, as `_target_`


Runs = Sequence[Run]


@dataclass(frozen=True)
class Repeated:
    """A table line with the `label`: runs that differ only in their seed. Figures are their means.

    `gaps` says why other runs are missing. For a data set, each of `runs` is a mean over scenes;
    `of_scenes` are the stored runs in these means, and `by_scene` has all measured ones by scene,
    first the scenes in the means.
    """

    label: str
    runs: Runs
    gaps: Sequence[str] = ()
    by_scene: Mapping[str, Runs] = field(default_factory=dict)
    of_scenes: Runs = ()

    @property
    def averaged(self) -> Runs:
        """The stored runs that its means are made of, each of a single scene."""
        return self.of_scenes or self.runs

    @property
    def measured(self) -> list[Run]:
        """The stored runs behind the figures, each of a single scene."""
        return [run for runs in self.by_scene.values() for run in runs] or list(self.runs)

    @property
    def keys(self) -> tuple[str, ...]:
        return tuple(run.key for run in self.measured)

    @property
    def conditions(self) -> tuple[object, ...]:
        return self.runs[0].conditions if self.runs else ()

    def mean(self, metric: str) -> float | None:
        """The mean of a metric; a stage includes its nested stages. None without figures."""
        figures = self._figures(metric)
        return float(np.mean(figures)) if figures else None

    def half(self, metric: str) -> float:
        """Half the 95 % interval of this mean; nan with fewer than two seeds."""
        return half_interval(np.array(self._figures(metric)))

    @property
    def parts(self) -> dict[str, float]:
        """The mean ms of each part of a frame; see `Run.parts`."""
        of_runs = pd.DataFrame([run.parts for run in self.runs]).fillna(0.0)
        return {str(part): float(ms) for part, ms in of_runs.mean().items()}

    def _figures(self, metric: str) -> list[float]:
        figures = (run.figure(metric) for run in self.runs)
        return [figure for figure in figures if figure is not None]


TableLines = Sequence[Repeated]


def readable(
    store: Store,
    keys: Collection[str] | None = None,
    report: Say = lambda unreadable: None,
) -> list[Run]:
    """Every readable run, or those in `keys`, labelled with its method, in the order of storing.

    `report` gets a line on those that cannot be read, for each reason.
    """
    rows = store.rows(report, keys)
    runs = [
        Run(
            folder.name,
            _label(record["command"], of_run),
            of_run,
            cache(partial(store.frames, folder.name)),
            record,
            folder / "pictures",
        )
        for key, of_run in rows.groupby("run")
        if (folder := store.find(str(key))) and (record := store.record(folder.name))
    ]
    return sorted(runs, key=lambda run: run.record["stored"])


def load_runs(store: Store, keys: Iterable[str]) -> list[Run]:
    """Load the runs with these `keys`, in this order, labelled with their methods.

    Raises SteerbenchError if one is not in the store, or cannot be read.
    """
    wanted, unread = list(keys), list[str]()
    runs = {run.key: run for run in readable(store, wanted, unread.append)}
    for key in wanted:
        if key not in runs:
            store.record(key)  # raises if there is none
            raise SteerbenchError("; ".join(unread))
    return [runs[key] for key in wanted]


def grouped(items: Iterable[T], key: Callable[[T], K]) -> dict[K, list[T]]:
    """The `items` that have the same `key`, by this key, in the order of the first of each."""
    groups: dict[K, list[T]] = {}
    for each in items:
        groups.setdefault(key(each), []).append(each)
    return groups


def _label(command: object, rows: pd.DataFrame) -> str:
    """The method, as it was typed if it was: a choice may have other settings than its method."""
    typed = [word for word in shlex.split(str(command)) if word.startswith("method=")]
    return typed[-1].partition("=")[2] if typed else str(rows["method"].iloc[0])


def flat(node: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """The values of nested settings by the names that one types."""
    for name, value in node.items():
        if isinstance(value, Mapping) and value:
            yield from flat(value, f"{before}{name}.")
        else:
            yield f"{before}{name}", value


def unseeded(config: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """The `flat` settings of a run without its seed, and without those of its method, which have
    the same."""
    for name, value in flat(config):
        of_method = name.startswith("method.") and name.endswith(".seed")
        if name != "seed" and not (of_method and value == config.get("seed")):
            yield name, value


def missing_figures(runs: Runs) -> list[str]:
    """Notes about every metric that could not be measured."""
    notes = (f"{name}: n/a. {why}" for run in runs for name, why in run.record["missing"].items())
    return list(dict.fromkeys(notes))


def over_common_frames(runs: Runs) -> list[Run]:
    """The same runs, with steady figures recomputed over the frames that are steady in all of them.

    "All" are those of the same views. A method with memory has fewer steady frames, and the first
    frames of a path are not typical: means over different frames would mislead. Runs without steady
    frames, or without a common one, are unchanged.
    """
    steady = [set(run.frames.loc[run.frames["phase"] == STEADY, "frame"]) for run in runs]
    common: dict[tuple[object, ...], set[int]] = {}
    for run, frames in zip(runs, steady, strict=True):
        if frames:
            common[run.views] = common.get(run.views, frames) & frames
    return [
        _over(run, kept) if (kept := common.get(run.views, frames)) and kept < frames else run
        for run, frames in zip(runs, steady, strict=True)
    ]


def _over(run: Run, kept: Collection[int]) -> Run:
    """The run with steady figures computed over the frames `kept`."""
    frames = run.frames
    chosen = frames[(frames["phase"] == STEADY) & frames["frame"].isin(kept)]
    found = pd.DataFrame(phase_rows(chosen)).set_index("metric")
    rows = run.rows.copy()
    changed = (rows["phase"] == STEADY) & rows["metric"].isin(found.index)
    for column in ("value", "n", "lo", "hi"):
        rows.loc[changed, column] = rows.loc[changed, "metric"].map(found[column])
    return replace(run, rows=rows)


def over_scenes(runs: Runs) -> Run:
    """Average runs of one seed and different scenes into one run.

    Its rows are means of their headline rows, for the metrics that all of them have; its frames are
    the frames of all. A stage or a work that a run lacks did not occur in it and counts as 0.
    """
    if len(runs) == 1:
        return runs[0]
    found = pd.concat([run.headline.reset_index() for run in runs])
    complete = found.groupby("metric")["value"].transform("size") == len(runs)
    found = found[complete | found["metric"].str.startswith(("stage_ms.", "work."))]
    rows = found.groupby("metric", sort=False).agg(
        unit=("unit", "first"),
        phase=("phase", "first"),
        value=("value", lambda values: values.sum(skipna=False) / len(runs)),
        n=("n", "sum"),
    )
    facts: dict[str, Any] = {**conditions(runs, list(map(str, runs[0].facts.index)))}
    facts["scene"] = f"mean of {', '.join(str(run.facts['scene']) for run in runs)}"
    facts["seed"] = runs[0].facts["seed"]
    key = facts["run"] = content_key({"mean of": [run.key for run in runs]})[:16]
    if "fps" in rows.index:  # of the mean time, as in a run
        rows.loc["fps", "value"] = 1000 / rows["value"]["frame_ms"]
    rows = rows.reset_index().assign(lo=math.nan, hi=math.nan, **facts)
    frames = cache(lambda: pd.concat([run.frames for run in runs], ignore_index=True))
    return Run(key, runs[0].label, rows, frames, _record(runs), runs[0].pictures)


def _record(runs: Runs) -> dict[str, Any]:
    """The record of the first run, with the scenes, machines and missing figures of all."""
    records = [run.record for run in runs]
    machines = [record["machine"] for record in records]
    machine = {name: joined(of[name] for of in machines) for name in ("cpu", "threads")}
    gpus = list(dict.fromkeys(gpu for of in machines for gpu in of["gpus"]))
    digest = content_key({"mean of": [run.digest for run in runs]})
    return {
        **records[0],
        "machine": {**machines[0], **machine, "gpus": gpus},
        "scene": {**records[0]["scene"], "digest": digest},
        "missing": {name: why for record in records for name, why in record["missing"].items()},
    }


def read_picture(path: Path) -> np.ndarray:
    """A picture that a run kept, uint8 [H, W, 3]."""
    check_sums(path.parent.parent, [f"{path.parent.name}/{path.name}"])
    return decode_bytes(contents(path), path)[..., :3].numpy()


def joined(values: Iterable[object]) -> str:
    """All different `values`, as text."""
    return " / ".join(dict.fromkeys(map(str, values)))


def conditions(runs: Runs, names: Sequence[str]) -> dict[str, str]:
    """The facts `names` of `runs`, each with all of its values."""
    return {name: joined(run.facts[name] for run in runs) for name in names}


def listed(values: Mapping[str, Any]) -> str:
    """Names with their values, as text."""
    return ", ".join(
        f"{name} {' + '.join(value) or 'none' if isinstance(value, list) else value}"
        for name, value in values.items()
    )
