"""`steerbench skips`: what a method skips, the time that this saves, and the error that it adds."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from bench.errors import SteerbenchError
from bench.study import Study, Variant
from reports.tables import Table, share
from sweeps.overrides import composed
from sweeps.terminal import print_rows, show
from sweeps.variants import (
    COMPARED,
    METHOD,
    amount,
    compared,
    compared_cells,
    declared,
    render_variants,
    settings,
    settings_of,
)

USUAL = (METHOD, "trajectory=smooth")


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    words, launcher = settings(options, *USUAL)
    config = composed(words)
    study = declared(config)
    if not study.skips:
        raise SteerbenchError(
            f"steerbench skips: {config.method._target_} declares nothing in `study.skips` "
            "(bench/study.py); expected a method that does, for example method=steernerf_lean"
        )
    # The user's words come last, so that they take precedence.
    words = [*USUAL, *study.skips_with, *words[len(USUAL) :]]
    rendered = render_variants(settings_of(words, _variants(study)), options, launcher)
    first = rendered[0]
    work = first.work()
    none = dict.fromkeys(work, 0.0)
    rows = [
        {"skipped": each.name, **compared(each, first), **none, **each.work()} for each in rendered
    ]
    lines = (
        (
            row["skipped"],
            *compared_cells(row),
            *(f"{amount(row[name])} ({share(row[name], work[name])})" for name in work),
        )
        for row in rows
    )
    title = f"{first.method}, {first.frames} frames: mean work of a frame, and its share"
    columns = ("skipped", *COMPARED, *(name.replace("_", " ") for name in work))
    show(Table(title, columns, tuple(lines)))
    print_rows(rows)
    return 0


def nothing_skipped(study: Study) -> tuple[str, ...]:
    """The settings that switch off all skips."""
    return tuple(f"{setting}=false" for setting in study.skips.values())


def _variants(study: Study) -> Iterator[Variant]:
    """Variants: nothing skipped, each skip alone, all skips, and further savings on top."""
    off = dict(zip(study.skips, nothing_skipped(study), strict=True))
    yield Variant("nothing", tuple(off.values()))
    for name in off:
        yield Variant(name, tuple(line for other, line in off.items() if other != name))
    yield Variant("all of these")
    yield from study.savings
