"""Prints tables at the terminal."""

from __future__ import annotations

import sys

from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from reports.tables import Table

PIPE_WIDTH = 200
"""Width of text without a terminal: wide enough for every table."""


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """Leave it to `sweeps.cli` to end the program; rich would exit by itself."""
        raise BrokenPipeError


def console() -> Console:
    """Standard output; in a file or pipe, tables are not cut to 80 columns."""
    return _Output(width=None if sys.stdout.isatty() else PIPE_WIDTH, highlight=False)


def show(*tables: Table) -> None:
    """Print `tables`, one below the other."""
    for table in tables:
        console().print(rich_table(table))


def rich_table(table: Table) -> RichTable:
    """`table` with labels and text aligned left and figures aligned right."""
    grid = RichTable(title=escape(table.title), title_justify="left")
    for index, column in enumerate(table.columns):
        grid.add_column(escape(column), justify="right" if index and table.figures else "left")
    for row, line in enumerate(table.lines):
        cells = (
            f"[bold]{escape(text)}[/bold]" if (row, column) in table.bold else escape(text)
            for column, text in enumerate(line)
        )
        grid.add_row(*cells)
    return grid
