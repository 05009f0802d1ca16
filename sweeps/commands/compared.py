"""`steerbench parity` and `steerbench skips`: variants of a method, each compared with the first.

`parity` compares every engine and precision with torch in fp32. `skips` shows what a frame takes,
and how it differs, without each of the skips.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Mapping

from bench.errors import SteerbenchError
from bench.study import Study, Variant
from reports.tables import Table, decimal, megabytes, share, spread
from sweeps import variants
from sweeps.overrides import composed
from sweeps.terminal import print_rows, show
from sweeps.variants import Row

USUAL = (variants.METHOD, "trajectory=smooth")
COMPARED = ("PSNR to the first, dB ↑", "PSNR, dB ↑", "lost, dB ↓", "frame, ms ↓", "of rounds")
NOTHING = "nothing"  # is skipped
OF_ENGINES: tuple[str, ...] = ("p99 / p50 ↓", "worst pixel ↓", "network, ms ↓", "network, MB ↓")


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    words, launcher = variants.settings(options, *USUAL)
    config = composed(words)
    study, parity = variants.declared(config), options.command == "parity"
    if parity and "engine" not in config.method:
        raise SteerbenchError(
            "steerbench parity compares the engines of a 2D renderer: expected a method with the "
            "setting method.engine, for example method=steernerf"
        )
    if not parity and not study.skips:
        raise SteerbenchError(
            f"steerbench skips: {config.method._target_} declares nothing in `study.skips` "
            "(bench/study.py); expected a method that does, for example method=steernerf"
        )
    if not parity:  # the user's words come last, so that they take precedence
        words = [*USUAL, *study.skips_with, *words[len(USUAL) :]]
    wanted = variants.words_of(words, variants.engines(words) if parity else _skips(study))
    rendered = variants.render(wanted, options, launcher)
    first = rendered[0]
    every = next((each for each in rendered if each["setting"] == NOTHING), first)
    title, work = f"{first['method']}, {first['frames']} frames", _work(every)
    label, first_column, further = "engine", "engine, precision", OF_ENGINES
    if not parity:
        title += ": mean work of a frame, and its share of all"
        label = first_column = "skipped"
        further = tuple(name.replace("_", " ") for name in work)
    rows, lines = [], []
    for each in rendered:
        own, cells = _of_engine(each, study) if parity else _of_skip(each, work)
        row = {
            label: each["setting"],
            "apart": each["psnr_to_first"],
            "psnr": each["psnr"],
            "lost": first["psnr"] - each["psnr"],
            **variants.times(each),
            **own,
        }
        rows.append(row)
        lines.append((row[label], *_compared(row), *cells))
    show(Table(title, (first_column, *COMPARED, *further), tuple(lines)))
    print_rows(rows)
    return 0


def _compared(row: Row) -> tuple[str, ...]:
    """The cells of the columns `COMPARED`."""
    apart = row["apart"]
    return (
        decimal(apart, 1) if math.isfinite(apart) else "the same",
        decimal(row["psnr"], 2),
        decimal(row["lost"], 3),
        decimal(row["frame_ms"], 1),
        spread(row["ms_lo"], row["ms_hi"]),
    )


def _of_engine(rendered: Row, study: Study) -> tuple[Row, tuple[str, ...]]:
    """The figures of an engine, and the cells of the columns `OF_ENGINES`."""
    worst, ms = rendered["worst"], rendered.get(f"stage_ms.{study.network_stage}")
    size = rendered.get(f"bytes.{study.network_size}")
    cells = (decimal(rendered["p99_to_p50"], 2), decimal(worst, 4), decimal(ms, 2), megabytes(size))
    return {"worst": worst, "network_ms": ms, "bytes": size}, cells


def _of_skip(rendered: Row, work: Mapping[str, float]) -> tuple[Row, tuple[str, ...]]:
    """The work of a frame, and as cells also its share of all the `work`."""
    own = {**dict.fromkeys(work, 0.0), **_work(rendered)}
    return own, tuple(
        f"{variants.amount(own[name])} ({share(own[name], of)})" for name, of in work.items()
    )


def _work(rendered: Row) -> dict[str, float]:
    """The work counters of a frame, without the `dense` ones."""
    return {
        name.removeprefix("work."): value
        for name, value in rendered.items()
        if name.startswith("work.") and not name.endswith(".dense")
    }


def _skips(study: Study) -> Iterator[Variant]:
    """Variants: all skips, further savings on top, all skips but each one, nothing skipped."""
    off = dict(zip(study.skips, variants.nothing_skipped(study), strict=True))
    yield Variant("all")
    yield from study.savings
    for name, word in off.items() if len(off) > 1 else ():
        yield Variant(f"all but {name}", (word,))
    yield Variant(NOTHING, tuple(off.values()))
