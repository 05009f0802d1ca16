"""`steerbench score`: scores pictures of any program against true ones, under a named protocol."""

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
from bench.pictures import Match, Pair
from bench.protocol import EvaluationProtocol
from bench.results import Store
from bench.sources import digest, libraries
from bench.types import SteerbenchError
from reports.runs import Run, load
from reports.tables import run_tables
from sweeps.build import build
from sweeps.configured import checked_settings, scene_of
from sweeps.deliver import send
from sweeps.names import unknown
from sweeps.overrides import composed
from sweeps.terminal import console, rich_table

NOTHING = "-"
"""Stands for facts of a row that do not apply to given pictures."""


def main(options: argparse.Namespace) -> int:
    """Score the pictures, keep the rows in the store, print them."""
    run = scored(
        options.pictures,
        options.truth,
        options.overrides,
        name=options.name,
        match=options.match,
        sequence=options.sequence,
    )
    facts, out = run.facts, console()
    heading = f"{run.label} on {facts['scene']}, protocol {facts['protocol']}: run {run.key}"
    out.print(heading, markup=False)
    out.print(Columns([rich_table(table) for table in run_tables(run.rows)]))
    return 0


def scored(
    folder: Path,
    truth: Path | None,
    words: Sequence[str],
    *,
    name: str | None = None,
    match: Match = "name",
    sequence: bool = False,
) -> Run:
    """Score the pictures in `folder` against those in `truth`, and store the result as a run.

    Args:
        truth: the folder of true pictures; None: the split of a scene.
        words: settings as for `steerbench run`: protocol, scene, split, outputs, pictures, tracker.
        name: name of the method in the rows; None: the name of the folder.
        match: how pictures are matched to true ones.
        sequence: whether the pictures are consecutive frames, so that flicker is scored, too.

    Raises:
        SteerbenchError: a setting is wrong; pictures are missing, damaged or of another size.
    """
    config = composed(words)
    settings = checked_settings(config)
    if config.report:
        raise SteerbenchError("report: a page compares times, which given pictures do not have")
    log, store = ConsoleLog(Path(settings.outputs)), Store(Path(settings.outputs))
    protocol: EvaluationProtocol = build(config, "protocol")
    weights = Path(settings.weights_dir) if settings.weights_dir else None
    if truth is None:
        pairs, place = _against_scene(folder, config, protocol, match)
    else:
        if named := [word for word in words if word.startswith("scene")]:
            raise SteerbenchError(f"--truth and {named[0]}: expected one of them")
        pairs = pictures.pairs_with_folder(folder, truth, match)
        place = {"scene": truth.resolve().name, "split": NOTHING}
    facts = {"method": name or folder.resolve().name, **place, "trajectory": "pictures", "seed": 0}
    facts |= dict.fromkeys(("budget", "device", "backend", "engine", "precision"), NOTHING)
    log.info(f"{len(pairs)} pictures, matched by {match}: {_example(pairs)}")
    lpips, missing = protocol.load_lpips(weights, log)
    measurement = pictures.score(
        pairs, protocol, lpips, facts, log, sequence=sequence, kept=settings.pictures
    )
    record = measurement.record
    parts = {
        "score": digest(pictures.score),
        "libraries": libraries(pictures.score),
        "pictures": record["pictures"],
        "truths": record["truths"],
        "protocol": asdict(protocol),
        "lpips": protocol.find_lpips(weights, log),
        "facts": facts,
        "sequence": sequence,
    }
    more: dict[str, Any] = {
        "command": shlex.join(_command(folder, truth, words, name, match, sequence)),
        "missing": missing,
        "scene": {"name": facts["scene"], "digest": record["truths"]},
        "budget": {"name": NOTHING},
    }
    key = store.key(parts)
    if store.find(key) is None:
        store.save(parts, replace(measurement, record={**record, **more}))
    label = {key: str(facts["method"])}
    send(config, store, key, label[key])
    (run,) = load(store, label)
    return run


def _against_scene(
    folder: Path, config: DictConfig, protocol: EvaluationProtocol, match: Match
) -> tuple[list[Pair], dict[str, Any]]:
    """Pairs of the pictures with those of the scene's split, and the facts for their rows."""
    OmegaConf.update(config, "scene.background", protocol.background)
    scene, split = scene_of(config), config.split
    if split not in scene.splits:
        raise unknown("split", split, scene.splits)
    pairs = pictures.pairs_with_split(folder, scene.splits[split], match)
    return pairs, {"scene": scene.name, "split": split}


def _command(
    folder: Path,
    truth: Path | None,
    words: Sequence[str],
    name: str | None,
    match: Match,
    sequence: bool,
) -> list[str]:
    """The command line that does the same."""
    named = (("--truth", truth), ("--name", name), ("--match", match))
    given = [str(word) for pair in named if pair[1] is not None for word in pair]
    flag = ["--sequence"] if sequence else []
    return ["steerbench", "score", str(folder), *given, *flag, *words]


def _example(pairs: Sequence[Pair]) -> str:
    """How the first picture was matched, for the user to check."""
    return f"{pairs[0].picture.name} is scored against {pairs[0].name}"
