"""`steerbench skips`: what is not computed, the time that saves, and the error it adds."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from bench.errors import SteerbenchError
from bench.study import Study, Variant
from reports.tables import Table, decimal, share
from sweeps.overrides import composed
from sweeps.studies.variants import (
    METHOD,
    Rendered,
    Row,
    amount,
    apart_text,
    declared,
    print_rows,
    range_text,
    render_variants,
    settings_of,
)
from sweeps.terminal import show

COLUMNS = (
    "skipped",
    "PSNR to nothing skipped, dB ↑",
    "PSNR, dB ↑",
    "lost, dB ↓",
    "frame, ms ↓",
    "of rounds",
)


def main(options: argparse.Namespace) -> int:
    """Print a table and, as the last line, the same rows as JSON."""
    words = [METHOD, "trajectory=smooth", *options.overrides]
    config = composed(words)
    study = declared(config)
    if not study.skips:
        raise SteerbenchError(
            f"steerbench skips: {config.method._target_} declares nothing in `study.skips` "
            "(bench/study.py); expected a method that does, for example method=steernerf_lean"
        )
    # What was typed comes last, so that it counts.
    words = [*words[:2], *study.skips_with, *options.overrides]
    found = render_variants(settings_of(words, _variants(study)), options.frames, options.repeats)
    rows = [_row(one, found[0]) for one in found]
    work = list(found[0].work())
    title = f"{found[0].method.name}, {found[0].frames} frames: mean work of a frame, and its share"
    lines = tuple(_line(row, rows[0], work) for row in rows)
    show(Table(title, (*COLUMNS, *(name.replace("_", " ") for name in work)), lines))
    print_rows(rows)
    return 0


def nothing_skipped(study: Study) -> tuple[str, ...]:
    """The settings that switch off all skips."""
    return tuple(f"{setting}=false" for setting in study.skips.values())


def _variants(study: Study) -> Iterator[Variant]:
    """Nothing skipped, each skip alone, all of them, and further savings on top."""
    off = dict(zip(study.skips, nothing_skipped(study), strict=True))
    yield Variant("nothing", tuple(off.values()))
    for name in off:
        yield Variant(name, tuple(line for other, line in off.items() if other != name))
    yield Variant("all of these")
    yield from study.savings


def _row(one: Rendered, standard: Rendered) -> Row:
    values = one.values
    return {
        "skipped": one.name,
        "apart": values["psnr_to_first"],
        "psnr": values["psnr"],
        "lost": standard.values["psnr"] - values["psnr"],
        "frame_ms": values["ms"],
        **{name: values[name] for name in ("ms_lo", "ms_hi")},
        **dict.fromkeys(standard.work(), 0.0),
        **one.work(),
    }


def _line(row: Row, dense: Row, work: list[str]) -> tuple[str, ...]:
    return (
        row["skipped"],
        apart_text(row["apart"]),
        decimal(row["psnr"], 2),
        decimal(row["lost"], 3),
        decimal(row["frame_ms"], 1),
        range_text(row),
        *(f"{amount(row[name])} ({share(row[name], dense[name])})" for name in work),
    )
