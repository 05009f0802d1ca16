"""`steerbench skips`: what a method skips, the time that this saves, and the error that it adds."""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from bench.errors import SteerbenchError
from bench.study import Study, Variant
from reports.tables import Table, share
from sweeps.overrides import composed
from sweeps.studies.variants import (
    COMPARED,
    METHOD,
    Row,
    amount,
    compared,
    compared_cells,
    declared,
    print_rows,
    render_variants,
    settings_of,
)
from sweeps.terminal import show


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    words = [METHOD, "trajectory=smooth", *options.overrides]
    config = composed(words)
    study = declared(config)
    if not study.skips:
        raise SteerbenchError(
            f"steerbench skips: {config.method._target_} declares nothing in `study.skips` "
            "(bench/study.py); expected a method that does, for example method=steernerf_lean"
        )
    # The user's words come last, so that they take precedence.
    words = [*words[:2], *study.skips_with, *options.overrides]
    found = render_variants(settings_of(words, _variants(study)), options.frames, options.repeats)
    work = found[0].work()
    none = dict.fromkeys(work, 0.0)
    rows = [{"skipped": one.name, **compared(one, found[0]), **none, **one.work()} for one in found]
    title = f"{found[0].method.name}, {found[0].frames} frames: mean work of a frame, and its share"
    columns = ("skipped", *COMPARED, *(name.replace("_", " ") for name in work))
    lines = tuple(_line(row, rows[0], list(work)) for row in rows)
    show(Table(title, columns, lines))
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


def _line(row: Row, dense: Row, work: list[str]) -> tuple[str, ...]:
    shares = (f"{amount(row[name])} ({share(row[name], dense[name])})" for name in work)
    return row["skipped"], *compared_cells(row), *shares
