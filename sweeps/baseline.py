"""Baselines: files with figures of runs, and whether the runs of a store are as good."""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError, explained, unexpected
from bench.records import made, read_record
from bench.results import Store, existing_store
from bench.sharing import whole
from reports.regression import LIMITS, Assertion, Figures, Limit, changes, limited
from reports.runs import unseeded
from sweeps.measurement import PLACES, Failure
from sweeps.versions import is_present, standing

SCHEMA = 3  # of baseline files
SUBJECT = ("method", "scene", "split", "trajectory", "resolution", "protocol", "budget")
ABSOLUTE = re.compile(r"""(?<![^\s=,'"\[])~?/(?:[^\s,'"\]]*/)?([^/\s,'"\]]+)/*""")
portable = partial(ABSOLUTE.sub, r"\1")  # leaves of absolute paths the last part
NOTHING = Assertion("every metric", math.nan, math.nan, math.nan, None, Limit(1), "missing")
TYPED = re.compile(r"[+~]*([\w.@/]+)=")  # a setting among the words of a command


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
        """The `same` runs among those `stored`, those with the fewest other defaults; not those of
        `others`."""
        taken = [x.settings for x in others if x is not self and x.subject == self.subject]
        there = [x for x in stored if self.same(x) and x.settings not in taken]
        return min(there, key=lambda each: len(self.differences(each)), default=None)


def _words(command: str) -> list[str]:
    """What determines a run among the words of its command."""
    others = (*PLACES, "hydra.mode", "seed")
    words = map(portable, shlex.split(command)[1:])
    return [word for word in words if word.partition("=")[0] not in others]


def _stored(store: Store, say: Callable[[str], object]) -> list[Entry]:
    """The runs of `store` that stand for their jobs, by entry; `say` gets a line on versions."""
    found: dict[str, Entry] = {}
    for run in standing(store, say):
        command = shlex.join(_words(str(run.record["command"])))
        made_of, seed = run.record["made_of"], str(run.facts["seed"])
        config = {**made_of.get("config", {"command": command}), "in_turns": "turns" in made_of}
        settings = {name: portable(str(value)) for name, value in unseeded(config)}
        entry = Entry([str(run.facts[x]) for x in SUBJECT], command, settings, {})
        key = json.dumps([entry.subject, settings], sort_keys=True)
        found.setdefault(key, entry).seeds.setdefault(seed, run)
    return list(found.values())


def read(path: Path) -> tuple[Mapping[str, Limit], list[Entry]]:
    """The limits by metric and the runs of a baseline; SteerbenchError if it cannot be read, or
    holds nothing that could be compared."""
    try:
        held = read_record(path)
        if held["schema"] != SCHEMA:
            raise unexpected(path, f"schema {SCHEMA}", held["schema"])
        for name, kind in (("limits", dict), ("runs", list)):
            if not isinstance(held[name], kind) or not held[name]:
                raise unexpected(f"{path}: {name}", f"some, as a {kind.__name__}", "none")
        limits = {x: made(Limit, of, f"{path}: limits.{x}") for x, of in held["limits"].items()}
        known = limited([f"{metric}=0" for metric in limits])  # refuses what is no metric
        for metric, limit in limits.items():
            _refuse_endless(f"{path}: limits.{metric}", (limit.absolute, limit.relative))
            if limit.better != (better := known[metric].better):
                raise unexpected(f"{path}: limits.{metric}.better", str(better), limit.better)
        runs = [made(Entry, of, f"{path}: runs[{n}]") for n, of in enumerate(held["runs"])]
        for n, run in enumerate(runs):
            if len(run.subject) != len(SUBJECT) or not run.seeds:
                raise unexpected(f"{path}: runs[{n}]", f"{', '.join(SUBJECT)}, and seeds", "others")
            for seed, of in run.seeds.items():
                run.seeds[seed] = _figures(of, limits, f"{path}: runs[{n}].seeds.{seed}")
        return limits, runs
    except SteerbenchError as error:
        way = "remove it, then " * path.exists() + f"`steerbench check --record {path}` writes one"
        raise SteerbenchError(f"no baseline: {error}; {way}") from error


def _figures(held: Any, limits: Mapping[str, Limit], where: str) -> Figures:
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


def record(path: Path, outputs: Path, words: Sequence[str], say: Callable[[str], object]) -> None:
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
    of = [{seed: Figures.of(run, limits) for seed, run in each.seeds.items()} for each in runs]
    figures = [replace(each, seeds=seeds) for each, seeds in zip(runs, of, strict=True)]
    held = {"schema": SCHEMA, "limits": limits, "runs": figures}
    with explained(path.parent), whole(path) as new:
        new.write_text(json.dumps(held, indent=1, default=asdict) + "\n", encoding="utf-8")
    say(f"{path}: {len(runs)} of the {len(stored)} runs in the store")
    metrics = {metric for each in runs for run in each.seeds.values() for metric in run.values}
    families = sorted({re.sub(r"\..*", ".*", metric) for metric in metrics - limits.keys()})
    say(f"left out: metrics without a limit: {', '.join(families)}")
    for failure in _failures(outputs):
        say(f"left out: a run that failed: {failure.why}")
    store.rows(report=say)  # on those that cannot be read


def checked(
    path: Path, outputs: Path, say: Callable[[str], object] = lambda line: None
) -> list[list[Assertion]]:
    """Whether every metric of each run of the baseline `path` is as good in the store; `say` gets
    a line on which of several versions of a run were taken."""
    limits, runs = read(path)
    store, found = existing_store(outputs), []
    stored, failures = _stored(store, say), list(_failures(outputs))
    for old in runs:
        before, new = list(old.seeds.values()), old.nearest(stored, runs)
        try:
            if failure := _failure_of(old, new, failures, store):
                raise SteerbenchError(f"failed with {failure.why}: {old.command}")
            if not new or (gone := sorted(old.seeds.keys() - new.seeds)):
                seeds = f" with seed={','.join(gone)}" if new else ""
                raise SteerbenchError(f"no such run{seeds} below {outputs}: {old.command}")
            after = [Figures.of(new.seeds[seed], limits) for seed in old.seeds]
            rows, notes = list(changes(before, after, limits)), list(_notes(old, new, after))
        except SteerbenchError as error:
            nothing = [replace(each, values={}, frames={}) for each in before]
            rows, notes = list(changes(before, nothing, limits)), [str(error)]
        rows = rows or [NOTHING]
        found.append([replace(x, run=_name(old, runs), note="; ".join(notes)) for x in rows])
    return found


def _notes(old: Entry, new: Entry, after: Sequence[Figures]) -> Iterator[str]:
    """What else to know of the runs `new`, whose figures are `after`."""
    was, now = old.settings, new.settings
    changed = [
        f"{name}={now.get(name, 'absent')} (was {was.get(name, 'absent')})"
        for name in old.differences(new)
    ]
    if changed:
        yield f"defaults that changed: {', '.join(changed)}"
    machines = [
        (one.machine, other.machine) for one, other in zip(old.seeds.values(), after, strict=True)
    ]
    for before, now_on in dict.fromkeys(pair for pair in machines if len(set(pair)) > 1):
        yield f"times and memory are not compared: measured on {now_on}, before on {before}"
    of_code = [new.seeds[seed] for seed in old.seeds if "command" not in old.settings]
    if not all(map(is_present, of_code)):
        yield "of other code than is here now: run it again"


def _failure_of(
    old: Entry, new: Entry | None, failures: Sequence[Failure], store: Store
) -> Failure | None:
    """The failure of a job that one of the runs `old` stands for, since it was last measured."""
    seeds = new.seeds.items() if new else ()
    jobs = {job for seed, run in seeds if seed in old.seeds for job in store.used(run.key)[1]}
    for failure in failures:
        given = dict(word.split("=", 1) for word in shlex.split(failure.command) if "=" in word)
        words = sorted(_words(failure.command))
        alike = any(words == sorted(shlex.split(x.command)) for x in (old, new) if x)
        if failure.job in jobs or (alike and given.get("seed", "0") in old.seeds):
            return failure
    return None


def _failures(outputs: Path) -> Iterator[Failure]:
    for file in sorted(outputs.glob("failures/*.json")):
        yield made(Failure, read_record(file), str(file))


def _name(one: Entry, of: Sequence[Entry]) -> str:
    """Its method and scene, and the words of its command that others of these have not."""
    alike = [shlex.split(each.command) for each in of if each.subject[:2] == one.subject[:2]]
    own = [word for word in shlex.split(one.command) if not all(word in x for x in alike)]
    return ", ".join((one.subject[0], f"scene {one.subject[1]}", *own))
