"""`steerbench accuracy`: run time against error of every knob that trades them."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from bench.accuracy import experiment_rows
from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from bench.frontier import best_instead, cheapest_within
from reports.accuracy import experiment_table, setting_table, write_accuracy
from sweeps.knobs import ALWAYS, knobs
from sweeps.measurement import checked_settings
from sweeps.overrides import composed
from sweeps.terminal import console, rich_table
from sweeps.turns import turn
from sweeps.variants import Variant, finite, render_variants, require_lean

SETTINGS = ("method=steernerf", "scene=totem", "budget=demo", "trajectory=orbit")


def main(options: argparse.Namespace) -> int:
    """Print both tables and the setting that was asked for; as the last line, all rows as JSON."""
    limit = None if options.within is None else decibels(options.within)
    overrides = _last_words([*SETTINGS, *options.overrides])
    config = composed(overrides)
    outputs = Path(checked_settings(config).outputs)
    require_lean(config, "steerbench accuracy turns all knobs of SteerNeRF")
    _check_taught(config, overrides)
    log = ConsoleLog(outputs)
    turned = _turned(options)
    settings: list[dict[str, Any]] = []
    if not options.kernels:
        settings = _setting_rows(overrides, turned, options)
        console().print(rich_table(setting_table(settings)))
    from methods.checks import found

    with turn("cpu", log):
        experiments = experiment_rows(found("experiments"), options.repeats, log)
    console().print(rich_table(experiment_table(experiments)))
    command = shlex.join(["steerbench", *sys.argv[1:]])
    page = write_accuracy(experiments, settings, outputs / "accuracy", command)
    log.info(f"report: {page}")
    if settings and limit is not None:
        print(_recommended(settings, limit))
    print(json.dumps({"kernels": experiments, "settings": [finite(row) for row in settings]}))
    return 0


def _check_taught(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse a step or a stop that nothing was taught: all settings are to be of one training."""
    untaught = composed(_last_words([*overrides, "method=steernerf_untaught"])).method.pipeline
    for name in ("steps", "stop"):
        got, taught = config.method.pipeline[name], untaught[f"taught_{name}"]
        if got != taught:
            raise SteerbenchError(
                f"method.pipeline.{name}: steerbench accuracy turns it itself, from what the model "
                f"was taught; expected {taught:g}, got {got:g}"
            )


def decibels(text: str) -> float:
    """The number in "0.1dB", "0.1 dB" or "0.1"; SteerbenchError where it is none or negative."""
    number = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(dB)?", text, re.IGNORECASE)
    if not number:
        raise SteerbenchError(f"--within: expected decibels, 0.1dB for example, got {text!r}")
    return float(number[1])


def _last_words(overrides: Sequence[str]) -> list[str]:
    """`overrides` without those that a later one of the same name replaces."""
    return list({line.partition("=")[0]: line for line in overrides}.values())


def _turned(options: argparse.Namespace) -> list[tuple[str, Variant]]:
    """The settings that were asked for, each with its knob."""
    known = knobs(options.trained)
    turned = [knob for knob in known if knob not in ALWAYS]
    chosen = set(ALWAYS)
    for part in options.filter or [""]:
        if not (found := {knob for knob in turned if part in knob}):
            raise SteerbenchError(
                f"--filter: no knob has {part!r} in its name; expected part of one of "
                f"{', '.join(turned)}"
            )
        chosen |= found
    return [(knob, v) for knob, some in known.items() if knob in chosen for v in some]


def _setting_rows(
    overrides: Sequence[str],
    turned: Sequence[tuple[str, Variant]],
    options: argparse.Namespace,
) -> list[dict[str, Any]]:
    """Of every setting its knob, overrides, costs and errors, what it loses against everything off
    and, in its place, the setting on the frontier; see `bench.accuracy.render_in_turns`."""
    lines = {v.name: _last_words([*overrides, *v.settings]) for _, v in turned}
    found = render_variants(lines, options.frames, options.repeats)
    scene, path, rendered = found[0].scene, found[0].path, [one.values for one in found]
    knob_of = {variant.name: knob for knob, variant in turned}
    best = best_instead([row["ms"] for row in rendered], [-row["psnr"] for row in rendered])
    return [
        {
            "scene": scene.name,
            "trajectory": path.name,
            "resolution": path.resolution,
            "knob": knob_of[row["setting"]],
            **row,
            "lost": rendered[0]["psnr"] - row["psnr"],
            "instead": rendered[instead]["setting"],
            "overrides": " ".join(lines[row["setting"]]),
        }
        for row, instead in zip(rendered, best, strict=True)
    ]


def _recommended(rows: Sequence[dict[str, Any]], limit: float) -> str:
    """The fastest setting that loses at most `limit` dB, as a command; everything off loses 0."""
    index = cheapest_within([row["ms"] for row in rows], [row["lost"] for row in rows], limit)
    assert index is not None
    row = rows[index]
    return (
        f"within {limit:g} dB of everything off: {row['setting']}, {row['ms']:.1f} ms, "
        f"{row['lost']:.3f} dB lost\nsteerbench run {row['overrides']}"
    )
