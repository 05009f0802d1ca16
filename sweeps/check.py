"""`steerbench check` and `steerbench compare`: are the figures as good as they were."""

from __future__ import annotations

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
from reports.runs import Run, load, readable
from sweeps.identity import PLACES
from sweeps.terminal import console, show

SCHEMA = 1
"""Of baseline files."""


def main(options: argparse.Namespace) -> int:
    """Compare the store with a baseline, or write one; 1 if anything is worse or missing."""
    if options.command == "compare":
        return _compare(options)
    found = _by_command(Store(options.outputs))
    if options.record:
        _record(options.baseline, found)
        return 0
    runs, limits = _read(options.baseline)
    failed = 0
    for command, figures in runs.items():
        if command not in found:
            console().print(f"{command}: no such run below {options.outputs}", markup=False)
            failed += 1
            continue
        try:
            rows = list(changes(figures, Figures.of(found[command], limits), limits))
        except SteerbenchError as error:
            text = f"{command}: {error}; `steerbench check --record` takes the new ones"
            console().print(text, markup=False)
            failed += 1
            continue
        failed += sum(row.verdict != "" for row in rows)
        show(change_table(command, rows))
    console().print("as good as the baseline" if not failed else f"worse or missing: {failed}")
    return int(failed > 0)


def _compare(options: argparse.Namespace) -> int:
    """Print what the second of two runs of the store is, less the first; 1 if it is worse."""
    store = Store(options.outputs)
    keys = [store.whole_key(key) for key in (options.old, options.new)]
    old, new = (Figures.of(load(store, {key: key})[0]) for key in keys)
    rows = list(changes(old, new))
    show(change_table(" to ".join(keys), rows))
    return int(any(row.verdict for row in rows))


def _by_command(store: Store) -> dict[str, Run]:
    """Every run, by what was typed for it; of several, the last that was stored."""
    return {_command(str(run.record["command"])): run for run in readable(store)}


def _command(typed: str) -> str:
    """What was typed, in one order, without what does not change a row."""
    words = shlex.split(typed)[2:]
    places = (*PLACES, "hydra.mode")
    return shlex.join(sorted(word for word in words if word.partition("=")[0] not in places))


def _record(path: Path, found: Mapping[str, Run]) -> None:
    """Write the figures of `found` to `path`; limits and choice of runs of a baseline that is there
    stay."""
    limits: Mapping[str, Limit] = LIMITS
    if path.exists():
        known, limits = _read(path)
        if missing := known.keys() - found.keys():
            raise SteerbenchError(f"{path}: no such run in the store: {sorted(missing)[0]}")
        found = {command: found[command] for command in known}
    if not found:
        raise SteerbenchError("there are no runs to record: `steerbench run` makes one")
    runs = {command: asdict(Figures.of(run, limits)) for command, run in found.items()}
    plain = {metric: asdict(limit) for metric, limit in limits.items()}
    text = json.dumps({"schema": SCHEMA, "limits": plain, "runs": runs}, indent=1)
    with explained(path.parent), whole(path) as new:
        new.write_text(text + "\n", encoding="utf-8")
    console().print(f"{path}: {len(runs)} runs", markup=False)


def _read(path: Path) -> tuple[dict[str, Figures], dict[str, Limit]]:
    try:
        held: Any = json.loads(path.read_text(encoding="utf-8"))
        if held["schema"] != SCHEMA:
            raise ValueError(f"schema {held['schema']}, expected {SCHEMA}")
        runs = {command: Figures(**figures) for command, figures in held["runs"].items()}
        return runs, {metric: Limit(**limit) for metric, limit in held["limits"].items()}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise SteerbenchError(
            f"{path}: no baseline ({error}); `steerbench check --record {path}` writes one"
        ) from error
