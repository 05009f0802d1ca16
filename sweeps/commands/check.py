"""`steerbench check`: are the figures as good as they were, when a baseline was recorded."""

import argparse
import json
import shlex
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bench.errors import SteerbenchError, explained
from bench.results import Store
from bench.sharing import whole
from reports.regression import LIMITS, Figures, Limit, change_table, changes
from reports.runs import Run, readable
from sweeps.measurement import PLACES
from sweeps.terminal import console, show

SCHEMA = 2  # of baseline files


def main(options: argparse.Namespace) -> int:
    """Compare the store with a baseline, or write one; 1 if anything is worse or missing."""
    stored = _by_command(Store(options.outputs))
    if options.record:
        _record(options.baseline, stored)
        return 0
    runs, limits = _read(options.baseline)
    failed = 0
    for command, old in runs.items():
        there = stored.get(command, {})
        if missing := old.keys() - there:
            seeds = f" with seed={','.join(sorted(missing))}" if there else ""
            why = f"no such run{seeds} below {options.outputs}"
        else:
            try:
                new = [Figures.of(there[seed], limits) for seed in old]
                rows = list(changes(list(old.values()), new, limits))
            except SteerbenchError as error:
                why = f"{error}; `steerbench check --record` takes the new ones"
            else:
                failed += sum(row.verdict != "" for row in rows)
                show(change_table(command, rows))
                if [each.machine for each in new] != [each.machine for each in old.values()]:
                    console().print("times and memory are not compared: of other machines")
                continue
        console().print(f"{command}: {why}", markup=False)
        failed += 1
    console().print("as good as the baseline" if not failed else f"worse or missing: {failed}")
    return int(failed > 0)


def _by_command(store: Store) -> dict[str, dict[str, Run]]:
    """Every run, by what was typed for it and by its seed; of several, the last that was stored."""
    stored: dict[str, dict[str, Run]] = {}
    others = (*PLACES, "hydra.mode", "seed")  # what does not change a row is left out, too
    for run in readable(store):
        words = shlex.split(str(run.record["command"]))[2:]
        kept = sorted(word for word in words if word.partition("=")[0] not in others)
        stored.setdefault(shlex.join(kept), {})[str(run.facts["seed"])] = run
    return stored


def _record(path: Path, stored: Mapping[str, Mapping[str, Run]]) -> None:
    """Write figures to `path`; a baseline that is there keeps its limits and its choice of runs."""
    limits: Mapping[str, Limit] = LIMITS
    if path.exists():
        known, limits = _read(path)
        if missing := known.keys() - stored.keys():
            raise SteerbenchError(f"{path}: no such run in the store: {sorted(missing)[0]}")
        stored = {command: stored[command] for command in known}
    if not stored:
        raise SteerbenchError("there are no runs to record: `steerbench run` makes one")
    runs = {
        command: {seed: asdict(Figures.of(run, limits)) for seed, run in seeds.items()}
        for command, seeds in stored.items()
    }
    plain = {metric: asdict(limit) for metric, limit in limits.items()}
    text = json.dumps({"schema": SCHEMA, "limits": plain, "runs": runs}, indent=1)
    with explained(path.parent), whole(path) as new:
        new.write_text(text + "\n", encoding="utf-8")
    console().print(f"{path}: {len(runs)} runs", markup=False)


def _read(path: Path) -> tuple[dict[str, dict[str, Figures]], dict[str, Limit]]:
    """The figures of a baseline, by what was typed and by seed, and its limits."""
    try:
        held: Any = json.loads(path.read_text(encoding="utf-8"))
        if held["schema"] != SCHEMA:
            raise ValueError(f"schema {held['schema']}, expected {SCHEMA}")
        runs = {
            command: {seed: Figures(**figures) for seed, figures in seeds.items()}
            for command, seeds in held["runs"].items()
        }
        return runs, {metric: Limit(**limit) for metric, limit in held["limits"].items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise SteerbenchError(
            f"{path}: no baseline ({error}); `steerbench check --record {path}` writes one"
        ) from error
