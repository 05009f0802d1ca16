"""What commands print: tables, rows, figures of a run, pages, and how long the rest takes."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Collection, Mapping
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.columns import Columns
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from bench.results import Store
from reports.tables import Table, run_tables

if TYPE_CHECKING:  # loads torch, which `steerbench list` does without
    import pandas as pd

    from reports.runs import Run, Runs


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """Leave it to `sweeps.cli` to end the program; rich would exit by itself."""
        raise BrokenPipeError


def console() -> Console:
    """Standard output; in a file or pipe lines are long."""
    return _Output(width=None if sys.stdout.isatty() else 200, highlight=False)


def show(table: Table, figures: pd.DataFrame | None = None, form: str | None = None) -> None:
    """Print `table`, in a file or pipe as Markdown; or, in the `form` asked for, its `figures`."""
    if form and figures is not None:
        from reports.export import exported

        print(exported(table, figures, form), end="", flush=True)
    elif sys.stdout.isatty():
        console().print(rich_table(table))
    else:
        print(table.section(), flush=True)


def show_run(run: Run, heading: str) -> None:
    tables, out = run_tables(run.rows), console()
    out.print(f"{heading}: run {run.key}", style="bold", markup=False)
    if out.is_terminal:
        out.print(Columns([rich_table(table) for table in tables]))
    else:
        for table in tables:
            show(table)


def say(line: str) -> None:
    """Print a line as it is."""
    console().print(line, markup=False, soft_wrap=True)


def note(line: str) -> None:
    """Print a line that is no result."""
    print(line, file=sys.stderr)


def say_missing(runs: Runs) -> None:
    from reports.runs import missing_figures  # loads torch

    for reason in missing_figures(runs):
        say(reason)


def write_page(
    report: str | None, store: Store, keys: Collection[str], failed: Mapping[str, str] = {}
) -> None:
    """Write a page into the folder `report`, if there is to be one, and print where it is.

    It shows the runs with these `keys`, if any, and says why other jobs `failed`, by name.
    """
    if report and keys:
        from reports import page  # loads matplotlib, which only a page needs

        note(f"report: {page.write_page(store, keys, Path(report), failed)}")


def print_rows(rows: Any) -> None:
    """Print `rows` as one line of JSON."""
    print(json.dumps(finite(rows)))


def finite(value: Any) -> Any:
    """`value` for JSON, which has no NaN and no infinity: null in their place."""
    if isinstance(value, Mapping):
        return {key: finite(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def time_left(seconds: float, measured: int, jobs: int) -> str:
    """Estimated time for `jobs` if `measured` ones took `seconds`; empty if none was measured."""
    if not (measured and jobs):
        return ""
    return f", about {timedelta(seconds=round(seconds / measured * jobs))} left"


def rich_table(table: Table) -> RichTable:
    """`table` with labels and text aligned left and figures aligned right."""
    grid = RichTable(title=escape(table.title), title_justify="left")
    for index, column in enumerate(table.columns):
        grid.add_column(escape(column), justify="right" if table.right(index) else "left")
    for line in table.lines:
        grid.add_row(*(re.sub(r"^\*\*(.*)\*\*$", r"[bold]\1[/]", escape(x)) for x in line))
    return grid
