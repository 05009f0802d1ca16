"""`steerbench accuracy`: run time against error, for every knob that trades one for the other."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping, Sequence

from omegaconf import DictConfig

from bench.accuracy import best_instead, cheapest_within, experiment_rows
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, unexpected
from bench.study import Variant
from methods import checks
from reports.tradeoff import experiment_table, setting_table, write_tradeoff
from sweeps import variants
from sweeps.overrides import composed
from sweeps.processes import device_lock
from sweeps.terminal import print_rows, show
from sweeps.variants import Row


def main(options: argparse.Namespace) -> int:
    """Print both tables and the recommended setting, then all rows as JSON in the last line."""
    limit = None if options.within is None else decibels(options.within)
    words, launcher = variants.settings(
        options, variants.METHOD, "scene=totem", "budget=demo", "trajectory=orbit"
    )
    words = _last_words(words)
    log = ConsoleLog(launcher.outputs)
    rows: list[Row] = []
    if not options.kernels:
        config = composed(words)
        knobs = _knobs(config, words, options.trained)
        if len(knobs) == 1:
            log.info(
                f"{config.method._target_} declares no knobs in `study` (bench/study.py): it is "
                "rendered as it is"
            )
        chosen = _chosen(knobs, options.filter)
        lines = {each.name: _last_words([*words, *each.settings]) for _, each in chosen}
        knob_of = {variant.name: knob for knob, variant in chosen}
        rows = variants.render(lines, options, launcher)
        best = best_instead([row["ms"] for row in rows], [-row["psnr"] for row in rows])
        for row, instead in zip(rows, best, strict=True):
            row["knob"] = knob_of[row["setting"]]
            row["lost"] = rows[0]["psnr"] - row["psnr"]
            row["instead"] = rows[instead]["setting"]  # on the frontier, and dominates it
            row["overrides"] = shlex.join(lines[row["setting"]])
        show(setting_table(rows))
    with device_lock("cpu", log):
        experiments = experiment_rows(checks.found("experiments"), options.repeats, log)
    show(experiment_table(experiments))
    command = shlex.join(["steerbench", *options.typed])
    folder = options.report or launcher.outputs / "accuracy"
    page = write_tradeoff(experiments, rows, folder, command)
    log.info(f"report: {page}")
    if rows and limit is not None:
        print(_recommended(rows, limit))
    print_rows({"kernels": experiments, "settings": rows})
    return 0


def decibels(text: str) -> float:
    """The number in "0.1dB", "0.1 dB" or "0.1"; SteerbenchError if invalid or negative."""
    number = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(dB)?", text, re.IGNORECASE)
    if not number:
        raise unexpected("--within", "decibels, 0.1dB for example", repr(text))
    return float(number[1])


def _last_words(words: Sequence[str]) -> list[str]:
    """`words` without those replaced by a later word for the same setting; options are kept."""
    key = {word: word if word.startswith("--") else word.partition("=")[0] for word in words}
    return list({key[word]: word for word in words}.values())


def _knobs(config: DictConfig, words: Sequence[str], trained: bool) -> dict[str, Sequence[Variant]]:
    """The variants of each knob, by the knob's name, with everything else unchanged.

    First come the two that the knobs are compared with: everything off, if the method declares what
    that is, and nothing changed. All use the same training, except those that `trained` adds.
    """
    study = variants.declared(config)
    standard, *others = (
        variants.engines(words) if "engine" in config.method else [variants.AS_IT_IS]
    )
    off = Variant("everything off", (*standard.settings, *study.exact))
    return {
        **({off.name: [off]} if off.settings else {}),
        variants.AS_IT_IS.name: [variants.AS_IT_IS],
        **study.knobs,
        **({"engine": others} if others else {}),
        **(study.trained if trained else {}),
    }


def _chosen(
    knobs: Mapping[str, Sequence[Variant]], parts: Sequence[str]
) -> list[tuple[str, Variant]]:
    """What all knobs are compared with, and variants of knobs with any of `parts` in their name."""
    chosen = set(list(knobs)[: list(knobs).index(variants.AS_IT_IS.name) + 1])
    turned = [knob for knob in knobs if knob not in chosen]
    for part in parts or [""]:
        matching = {knob for knob in turned if part in knob}
        if parts and not matching:
            there = f"expected part of one of {', '.join(turned)}"
            raise SteerbenchError(f"--filter: no knob has {part!r} in its name; {there}")
        chosen |= matching
    return [(knob, variant) for knob, some in knobs.items() if knob in chosen for variant in some]


def _recommended(rows: Sequence[Row], limit: float) -> str:
    """The fastest setting that loses at most `limit` dB, as a command."""
    index = cheapest_within([row["ms"] for row in rows], [row["lost"] for row in rows], limit)
    if index is None:  # the first is perfect
        first = rows[0]["setting"]
        return f"within {limit:g} dB: no setting, because {first!r} has an infinite PSNR"
    row = rows[index]
    return (
        f"within {limit:g} dB of {rows[0]['setting']}: {row['setting']}, {row['ms']:.1f} ms, "
        f"{row['lost']:.3f} dB lost\nsteerbench run {row['overrides']}"
    )
