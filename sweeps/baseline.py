"""Baselines: files with figures of runs, and whether the runs of a store are as good."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError, explained, some, unexpected
from bench.kinds import Say, Words
from bench.records import made, read_record
from bench.results import Store, existing_store
from bench.sharing import whole
from reports.regression import LIMITS, Assertion, Figures, Limit, Limits, changes, limited
from reports.runs import Run, unseeded
from sweeps.measurement import PLACES, Failure, failures, own_words, portable
from sweeps.versions import is_present, standing

SCHEMA = 3  # of baseline files
SUBJECT = ("method", "scene", "split", "trajectory", "resolution", "protocol", "budget")
NOTHING = Assertion("every metric", math.nan, math.nan, math.nan, None, Limit(1), "missing")
TYPED = re.compile(r"[+~]*([\w.@/]+)=")  # a setting among the words of a command


Checks = list[list[Assertion]]  # of the metrics of each run


@dataclass(frozen=True)
class Entry:
    """Runs by seed that are equal in all else: what `SUBJECT` names, and the flat `settings`.
    Pictures that were only scored have the words of their command as setting."""

    subject: Sequence[str]
    command: str
    settings: Mapping[str, str]
    seeds: dict[str, Any]  # the Run of each in a store, the Figures of each in a baseline

    def differences(self, other: Entry) -> list[str]:
        """The names of the settings of `other` that are not as here."""
        old, new = self.settings, other.settings
        return sorted(name for name in {*old, *new} if old.get(name) != new.get(name))

    def same(self, other: Entry) -> bool:
        """Whether `other` is the same run: whatever was typed for either is equal, so that they
        differ in nothing but defaults."""
        apart = self.differences(other)
        if apart and self.subject == other.subject:
            words = set(shlex.split(self.command)) ^ set(shlex.split(other.command))
            return all(self._equal_below(word, other, apart) for word in words)
        return self.subject == other.subject

    def _equal_below(self, word: str, other: Entry, apart: Sequence[str]) -> bool:
        """Whether no setting that a typed `word` is about is `apart`; of a choice that is about
        none, such as an experiment, nothing is known."""
        typed = TYPED.match(word)
        settings = {*self.settings, *other.settings}
        about = {x for x in settings if typed and f"{x}.".startswith(f"{typed[1]}.")}
        return bool(about) and about.isdisjoint(apart)

    def nearest(self, stored: Sequence[Entry], others: Sequence[Entry]) -> Entry | None:
        """The `same` runs among those `stored`, those used last, which come first: of defaults as
        they are now; not those of `others`."""
        taken = [x.settings for x in others if x is not self and x.subject == self.subject]
        there = (x for x in stored if self.same(x) and x.settings not in taken)
        return next(there, None)


def _stored(store: Store, say: Say) -> list[Entry]:
    """The runs of `store` that stand for their jobs, by entry; `say` gets a line on versions."""
    found: dict[str, Entry] = {}
    for run in standing(store, say):
        made_of = run.record["made_of"]
        words, _ = _without_seed(own_words(run.command))
        command = shlex.join(words)
        config = {
            **made_of.get("config", {"command": command}),
            "in_turns": "turns" in made_of,
        }
        entry = Entry(
            subject=[str(run.facts[name]) for name in SUBJECT],
            command=command,
            settings={name: portable(str(value)) for name, value in unseeded(config)},
            seeds={},
        )
        key = json.dumps([entry.subject, entry.settings], sort_keys=True)
        entry = found.setdefault(key, entry)
        other = entry.seeds.setdefault(str(run.facts["seed"]), run)
        if _places(other) != _places(run):
            raise SteerbenchError(
                f"runs {other.key} and {run.key} are of {_places(other)} and {_places(run)}, which "
                "a baseline knows as one by the last parts of their paths: rename one, or keep "
                "them in stores of their own"
            )
    return list(found.values())


def _places(run: Run) -> str:
    """The folder of the scene of a run or, of scored pictures, the command that names both."""
    if "scene_path" in run.record:
        return str(run.record["scene_path"])
    words = shlex.split(run.command)
    return " ".join(word for word in words if word.partition("=")[0] not in PLACES)


def read(path: Path) -> tuple[Limits, list[Entry]]:
    """The limits by metric and the runs of a baseline; SteerbenchError if it cannot be read, or
    holds nothing that could be compared."""
    try:
        held = read_record(path)
        if held["schema"] != SCHEMA:
            raise unexpected(path, f"schema {SCHEMA}", held["schema"])
        for name, kind in (("limits", dict), ("runs", list)):
            if not isinstance(held[name], kind) or not held[name]:
                raise unexpected(f"{path}: {name}", f"some, as a {kind.__name__}", "none")
        limits = _limits(held["limits"], f"{path}: limits")
        entries = [
            _entry(one, limits, f"{path}: runs[{number}]")
            for number, one in enumerate(held["runs"])
        ]
        return limits, entries
    except SteerbenchError as error:
        way = "remove it, then " * path.exists() + f"`steerbench check --record {path}` writes one"
        raise SteerbenchError(f"no baseline: {error}; {way}") from error


def _limits(held: Mapping[str, Any], where: str) -> dict[str, Limit]:
    """The limits in a baseline, of metrics that exist, in their direction."""
    limits = {}
    known = limited([f"{metric}=0" for metric in held])  # refuses what is no metric
    for metric, one in held.items():
        limit = limits[metric] = made(Limit, one, f"{where}.{metric}")
        _refuse_endless(f"{where}.{metric}", (limit.absolute, limit.relative))
        better = known[metric].better
        if limit.better != better:
            raise unexpected(f"{where}.{metric}.better", str(better), limit.better)
    return limits


def _entry(held: Any, limits: Limits, where: str) -> Entry:
    """One entry of a baseline, with figures."""
    entry = made(Entry, held, where)
    if len(entry.subject) != len(SUBJECT) or not entry.seeds:
        raise unexpected(where, f"{', '.join(SUBJECT)}, and seeds", "others")
    for seed, figures in entry.seeds.items():
        entry.seeds[seed] = _figures(figures, limits, f"{where}.seeds.{seed}")
    return entry


def _figures(held: Any, limits: Limits, where: str) -> Figures:
    """The figures of one run in a baseline; those that are compared are numbers."""
    figures = made(Figures, held, where)
    compared = {x: value for x, value in figures.values.items() if x in limits}
    if not compared:
        raise unexpected(f"{where}.values", "figures with a limit", "none")
    for metric, value in compared.items():
        frames = figures.frames.get(metric, {})
        # Pictures without any error have an infinite PSNR; nothing else is.
        perfect = [math.inf] * (limits[metric].better > 0)
        _refuse_endless(f"{where}.{metric}", (value, *frames.values()), perfect)
    return figures


def _refuse_endless(where: str, values: Iterable[float], but_for: Sequence[float] = ()) -> None:
    for value in values:
        if value not in but_for and not -1e300 < value < 1e300:  # nan, inf, 400 digits
            raise unexpected(where, "a finite number", str(value)[:20])


def record(path: Path, outputs: Path, words: Words, say: Say) -> None:
    """Write figures to `path`; `words` are limits (psnr=0.2), `say` gets what is left out. A
    baseline that is there keeps its other limits and its choice of runs."""
    store, limits = existing_store(outputs), LIMITS
    runs = stored = _stored(store, say)
    if path.exists():
        limits, old = read(path)
        runs = [found for each in old if (found := each.nearest(stored, old))]
        if len(runs) < len(old):
            raise SteerbenchError(f"{path}: `steerbench check {path}` says which runs are missing")
    limits = limited(words, limits)
    entries = []
    for each in runs:
        figures = {seed: Figures.of(run, limits) for seed, run in each.seeds.items()}
        entries.append(replace(each, seeds=figures))
    held = {"schema": SCHEMA, "limits": limits, "runs": entries}
    with explained(path.parent), whole(path) as new:
        new.write_text(json.dumps(held, indent=1, default=asdict) + "\n", encoding="utf-8")
    say(f"{path}: {len(runs)} of the {len(stored)} runs in the store")
    _say_left_out(runs, limits, say)
    for failure in failures(outputs).values():
        say(f"left out: a run that failed: {failure.why}")
    store.rows(report=say)  # on those that cannot be read


def _say_left_out(runs: Sequence[Entry], limits: Limits, say: Say) -> None:
    metrics = {
        metric
        for each in runs
        for run in each.seeds.values()
        for metric in run.values
        if metric not in limits
    }
    families = sorted({re.sub(r"\..*", ".*", metric) for metric in metrics})
    say(f"left out: metrics without a limit: {', '.join(families)}")
    for each in runs:
        for seed, run in each.seeds.items():
            if unknown := [x for x, of in run.values.items() if x in limits and math.isnan(of)]:
                say(f"left out: of {each.command} seed={seed}, which has none: {some(unknown)}")


def checked(path: Path, outputs: Path, say: Say = lambda line: None) -> Checks:
    """Whether every metric of each run of the baseline `path` is as good in the store; `say` gets
    a line on which of several versions of a run were taken."""
    limits, entries = read(path)
    store = existing_store(outputs)
    stored, failed = _stored(store, say), list(failures(outputs).values())
    found = []
    for old in entries:
        new = old.nearest(stored, entries)
        try:
            if failure := _failure_of(old, new, failed, store):
                raise SteerbenchError(f"failed with {failure.why}: {old.command}")
            rows, note = _compared(old, new, limits, outputs)
        except SteerbenchError as error:
            before = list(old.seeds.values())
            nothing = [replace(figures, values={}, frames={}) for figures in before]
            rows, note = list(changes(before, nothing, limits)), str(error)
        name = _name(old, entries)
        found.append([replace(row, run=name, note=note) for row in rows or [NOTHING]])
    return found


def _compared(
    old: Entry, new: Entry | None, limits: Limits, outputs: Path
) -> tuple[list[Assertion], str]:
    """What became of the metrics of `old` in its runs `new`, and what else to know of these; raises
    SteerbenchError if some are missing, or of other frames."""
    if new is None:
        raise SteerbenchError(f"no such run below {outputs}: {old.command}")
    if gone := sorted(old.seeds.keys() - new.seeds):
        raise SteerbenchError(
            f"no such run with seed={','.join(gone)} below {outputs}: {old.command}"
        )
    before = list(old.seeds.values())
    after = [Figures.of(new.seeds[seed], limits) for seed in old.seeds]
    rows = list(changes(before, after, limits))
    return rows, "; ".join(_notes(old, new, after))


def _notes(old: Entry, new: Entry, after: Sequence[Figures]) -> Iterator[str]:
    """What else to know of the runs `new`, whose figures are `after`."""
    was, now = old.settings, new.settings
    changed = [
        f"{name}={now.get(name, 'absent')} (was {was.get(name, 'absent')})"
        for name in old.differences(new)
    ]
    if changed:
        yield f"defaults that changed: {', '.join(changed)}"
    for then, here in zip(old.seeds.values(), after, strict=True):
        if then.machine != here.machine:
            yield (
                f"times and memory are not compared: measured on {here.machine}, before on "
                f"{then.machine}"
            )
            break
    scored_alone = "command" in old.settings
    if not scored_alone and not all(is_present(new.seeds[seed]) for seed in old.seeds):
        yield "of other code than is here now: run it again"


def _failure_of(
    old: Entry, new: Entry | None, failed: Sequence[Failure], store: Store
) -> Failure | None:
    """The failure of a job that one of the runs `old` or `new` stands for, since it last ended
    well: a job that asked for the run, or one of the same words."""
    runs = [new.seeds[seed] for seed in old.seeds if seed in new.seeds] if new else []
    jobs = {job for run in runs for job in store.used(run.key)[1]}
    commands = [sorted(shlex.split(one.command)) for one in (old, new) if one]
    for failure in failed:
        words, seed = _without_seed(own_words(failure.command))
        alike = sorted(words) in commands and seed in old.seeds
        if alike or failure.job in jobs:
            return failure
    return None


def _without_seed(words: Words) -> tuple[list[str], str]:
    """The words of a command but for its seed, and this, 0 where none is given."""
    seeds = ["0", *(word.removeprefix("seed=") for word in words if word.startswith("seed="))]
    return [word for word in words if not word.startswith("seed=")], seeds[-1]


def _name(one: Entry, of: Sequence[Entry]) -> str:
    """Its method and scene, and the words of its command that others of these have not."""
    alike = [shlex.split(each.command) for each in of if each.subject[:2] == one.subject[:2]]
    own = [word for word in shlex.split(one.command) if not all(word in x for x in alike)]
    return ", ".join((one.subject[0], f"scene {one.subject[1]}", *own))
