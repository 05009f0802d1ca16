"""`steerbench score`: pictures of any program against true ones, under a named protocol."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from rich.columns import Columns

from bench import pictures
from bench.console import ConsoleLog
from bench.pictures import Pair
from bench.protocol import EvaluationProtocol
from bench.results import Store
from bench.sources import digest, libraries
from bench.types import Log, SteerbenchError
from reports.runs import load
from reports.tables import run_tables
from sweeps.build import build
from sweeps.measurement import checked_settings, scene_of
from sweeps.names import unknown
from sweeps.overrides import composed
from sweeps.terminal import console, rich_table

NOTHING = "-"
"""For facts of a row that pictures do not have."""


def main(options: argparse.Namespace) -> int:
    """Score the pictures, keep the rows in the store, print them."""
    config = composed(options.overrides)
    settings = checked_settings(config)
    log, store = ConsoleLog(Path(settings.outputs)), Store(Path(settings.outputs))
    protocol: EvaluationProtocol = build(config, "protocol")
    weights = Path(settings.weights_dir) if settings.weights_dir else None
    pairs, facts = _pairs(options, config, protocol, log)
    log.info(f"{len(pairs)} pictures, matched by {options.match}: {_example(pairs)}")
    lpips, missing = protocol.load_lpips(weights, log)
    sequence = options.sequence
    measurement = pictures.score(pairs, protocol, lpips, facts, log, sequence=sequence)
    record = measurement.record
    parts = {
        "score": digest(pictures.score),
        "libraries": libraries(pictures.score),
        "content": record["content"],
        "protocol": asdict(protocol),
        "lpips": protocol.find_lpips(weights, log),
        "facts": facts,
        "sequence": sequence,
    }
    more: dict[str, Any] = {
        "command": shlex.join(_typed(options)),
        "missing": missing,
        "scene": {"name": facts["scene"], "digest": record["content"]},
        "budget": {"name": NOTHING},
    }
    key = store.key(parts)
    if store.find(key) is None:
        store.save(parts, replace(measurement, record={**record, **more}))
    (run,) = load(store, {key: facts["method"]})
    out = console()
    out.print(f"{facts['method']} on {facts['scene']}, protocol {protocol.name}: run {key}")
    out.print(Columns([rich_table(table) for table in run_tables(run.rows)]))
    return 0


def _pairs(
    options: argparse.Namespace, config: DictConfig, protocol: EvaluationProtocol, log: Log
) -> tuple[list[Pair], dict[str, Any]]:
    """The pictures with their truth, and the facts of their rows."""
    if options.truth:
        if named := [word for word in options.overrides if word.startswith("scene")]:
            raise SteerbenchError(f"--truth and {named[0]}: expected one of them")
        pairs = pictures.pairs_with_folder(options.pictures, options.truth, options.match)
        scene, split = options.truth.resolve().name, NOTHING
    else:
        OmegaConf.update(config, "scene.background", protocol.background)
        loaded, split = scene_of(config), config.split
        if split not in loaded.splits:
            raise unknown("split", split, loaded.splits)
        pairs = pictures.pairs_with_split(options.pictures, loaded.splits[split], options.match)
        scene = loaded.name
    name = options.name or options.pictures.resolve().name
    unknown_facts = ("budget", "device", "backend", "engine", "precision")
    facts = {"method": name, "scene": scene, "split": split, "trajectory": "pictures", "seed": 0}
    return pairs, facts | dict.fromkeys(unknown_facts, NOTHING)


def _typed(options: argparse.Namespace) -> list[str]:
    """The command that was typed."""
    named = (("--truth", options.truth), ("--name", options.name), ("--match", options.match))
    words = ["steerbench", "score", str(options.pictures)]
    words += [str(word) for pair in named if pair[1] is not None for word in pair]
    return [*words, *(["--sequence"] if options.sequence else []), *options.overrides]


def _example(pairs: Sequence[Pair]) -> str:
    """How the first one was matched, for the eye."""
    return f"{pairs[0].picture.name} is scored against {pairs[0].name}"
