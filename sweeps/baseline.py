"""Baselines: files with figures of runs, and whether the runs of a store are as good."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError, explained, unexpected
from bench.records import made, read_record
from bench.results import Store, existing_store
from bench.sharing import whole
from reports.regression import LIMITS, Assertion, Figures, Limit, changes, limited
from reports.runs import readable, unseeded
from sweeps.measurement import PLACES

SCHEMA = 3  # of baseline files
SUBJECT = ("method", "scene", "split", "trajectory", "resolution", "protocol", "budget")
ABSOLUTE = re.compile(r"""(?<![^\s=,'"\[])~?/(?:[^\s,'"\]]*/)?([^/\s,'"\]]+)/*""")
portable = partial(ABSOLUTE.sub, r"\1")  # leaves of absolute paths the last part


@dataclass(frozen=True)
class Entry:
    """Runs by seed that are equal in all else: what `SUBJECT` names, and the flat `settings`.
    Pictures that were only scored have the words of their command as setting."""

    subject: Sequence[str]
    command: str
    settings: Mapping[str, str]
    seeds: dict[str, Any]  # the Run of each in a store, the Figures of each in a baseline

    def differences(self, other: Entry) -> list[str]:
        """The settings of `other` that are not as here."""
        old, new = self.settings, other.settings
        names = sorted(name for name in {*old, *new} if old.get(name) != new.get(name))
        return [f"{x}={new.get(x, 'absent')} (was {old.get(x, 'absent')})" for x in names]

    def nearest(self, stored: Sequence[Entry], others: Sequence[Entry]) -> Entry | None:
        """Its runs in a store: those of the same subject with the same settings, or else with the
        most of them, because a default that changed makes no other run; not those of `others`."""
        taken = [x.settings for x in others if x is not self and x.subject == self.subject]
        there = [x for x in stored if x.subject == self.subject and x.settings not in taken]
        return min(there, key=lambda each: len(self.differences(each)), default=None)


def _stored(store: Store) -> list[Entry]:
    """All runs of `store`; of several with equal settings and seed, the last."""
    found: dict[str, Entry] = {}
    others = (*PLACES, "hydra.mode", "seed")
    for run in readable(store):
        words = map(portable, shlex.split(str(run.record["command"]))[1:])
        command = shlex.join(word for word in words if word.partition("=")[0] not in others)
        made_of, seed = run.record["made_of"], str(run.facts["seed"])
        config = {**made_of.get("config", {"command": command}), "in_turns": "turns" in made_of}
        settings = {name: portable(str(value)) for name, value in unseeded(config)}
        entry = Entry([str(run.facts[x]) for x in SUBJECT], command, settings, {})
        key = json.dumps([entry.subject, settings], sort_keys=True)
        found.setdefault(key, entry).seeds[seed] = run
    return list(found.values())


def read(path: Path) -> tuple[Mapping[str, Limit], list[Entry]]:
    """The limits by metric and the runs of a baseline; SteerbenchError if it cannot be read."""
    try:
        held = read_record(path)
        if held["schema"] != SCHEMA:
            raise unexpected(path, f"schema {SCHEMA}", held["schema"])
        if not isinstance(held["limits"], dict) or not isinstance(held["runs"], list):
            raise unexpected(path, "limits by metric, and a list of runs", "others")
        limits = {x: made(Limit, of, f"{path}: limits.{x}") for x, of in held["limits"].items()}
        limited([f"{metric}=0" for metric in limits])  # refuses what is no metric
        runs = [made(Entry, of, f"{path}: runs[{n}]") for n, of in enumerate(held["runs"])]
        for n, run in enumerate(runs):
            if len(run.subject) != len(SUBJECT) or not run.seeds:
                raise unexpected(f"{path}: runs[{n}]", f"{', '.join(SUBJECT)}, and seeds", "others")
            for seed, of in run.seeds.items():
                run.seeds[seed] = made(Figures, of, f"{path}: runs[{n}].seeds.{seed}")
        return limits, runs
    except SteerbenchError as error:
        way = "remove it, then " * path.exists() + f"`steerbench check --record {path}` writes one"
        raise SteerbenchError(f"no baseline: {error}; {way}") from error


def record(path: Path, outputs: Path, words: Sequence[str], say: Callable[[str], object]) -> None:
    """Write figures to `path`; `words` are limits (psnr=0.2), `say` gets what is left out. A
    baseline that is there keeps its other limits and its choice of runs."""
    store, limits = existing_store(outputs), LIMITS
    runs = stored = _stored(store)
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
    for failure in sorted(outputs.glob("failures/*.txt")):
        say(f"left out: a run that failed: {failure.read_text(encoding='utf-8').strip()}")
    store.rows(report=say)  # on those that cannot be read


def checked(path: Path, outputs: Path) -> list[list[Assertion]]:
    """Whether every metric of each run of the baseline `path` is as good in the store."""
    limits, runs = read(path)
    stored, found = _stored(existing_store(outputs)), []
    for old in runs:
        new, before, notes = old.nearest(stored, runs), list(old.seeds.values()), []
        try:
            if not new or (gone := sorted(old.seeds.keys() - new.seeds)):
                seeds = f" with seed={','.join(gone)}" if new else ""
                raise SteerbenchError(f"no such run{seeds} below {outputs}: {old.command}")
            after = [Figures.of(new.seeds[seed], limits) for seed in old.seeds]
            rows = list(changes(before, after, limits))
            if others := old.differences(new):
                notes.append(f"other settings: {', '.join(others)}")
            if [each.machine for each in before] != [each.machine for each in after]:
                notes.append("times and memory are not compared: of other machines")
        except SteerbenchError as error:
            nothing = [replace(each, values={}, frames={}) for each in before]
            rows, notes = list(changes(before, nothing, limits)), [str(error)]
        found.append([replace(x, run=_name(old, runs), note="; ".join(notes)) for x in rows])
    return [rows for rows in found if rows]


def _name(one: Entry, of: Sequence[Entry]) -> str:
    """Its method and scene, and the words of its command that others of these have not."""
    alike = [shlex.split(each.command) for each in of if each.subject[:2] == one.subject[:2]]
    own = [word for word in shlex.split(one.command) if not all(word in x for x in alike)]
    return ", ".join((one.subject[0], f"scene {one.subject[1]}", *own))
