"""Exports the paper's tables: LaTeX for an article, CSV for a spreadsheet."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

import pandas as pd

from reports.comparison import conditions_of, marked, shown_as
from reports.paper_tables import Measured, PaperTable, Shown
from reports.tables import decimal

DECIMALS = {"ssim": 3, "lpips": 3, "frame": 2, "size": 1}
"""Decimals of the paper where pages have others, by the first part of a metric's name."""

ESCAPES = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
        "\\": r"\textbackslash{}",
        "^": r"\textasciicircum{}",
        "~": r"\textasciitilde{}",
        "<": "$<$",
        ">": "$>$",
        "±": r"$\pm$",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "–": "--",
    }
)

POWER = re.compile(r"\\textasciicircum\{\}(\d+)")  # as `ESCAPES` leaves it

MARKS = (r"\textbf{%s}", r"\underline{%s}")
"""LaTeX for the best and the second-best figure of a column."""


def latex(tables: Sequence[PaperTable], measured: Measured) -> str:
    """All tables as LaTeX, for the package booktabs, with as many decimals as in the paper.

    Among figures under the same conditions, the best of a column is bold and, of at least three,
    the second best is underlined; figures that look the same share a rank.
    """
    return "\n".join(_latex(table, measured) for table in tables)


def _latex(table: PaperTable, measured: Measured) -> str:
    blocks = table.shown(measured)
    runs = [run for block in blocks for line in block.measured for run in line.runs]
    caption = f"{_escaped(table.title)}. " + (f"{_escaped(conditions_of(runs))}." if runs else "")
    heads = ["", *(_escaped(shown_as(metric).heading) for metric in table.metrics)]
    parts = ([heads], *map(_rows, blocks))
    rows = ("\n".join(" & ".join(row) + r" \\" for row in part) for part in parts)
    return "\n".join(
        (
            r"\begin{table}",
            rf"\caption{{{caption.strip()}}}",
            rf"\label{{tab:{table.name}}}",
            rf"\begin{{tabular}}{{l{'r' * len(table.metrics)}}}",
            r"\toprule",
            "\n\\midrule\n".join(rows),
            r"\bottomrule",
            r"\end{tabular}",
            "\\end{table}\n",
        )
    )


def _rows(block: Shown) -> list[list[str]]:
    """The cells of a block; labels of a further one also have its data set."""
    columns = [
        marked(block.measured, metric, MARKS, partial(_written, metric))
        for metric in block.table.metrics
    ]
    where = f" ({block.title})" if block.title else ""
    return [
        [_escaped(line.label + where), *((text or "--").replace("±", r"$\pm$") for text in row)]
        for line, *row in zip(block.measured, *columns, strict=True)
    ]


def csv(tables: Sequence[PaperTable], measured: Measured) -> str:
    """All tables as CSV, one figure per row, in the units of `steerbench results`.

    A row has the measured mean, the number of runs, half the 95 % interval, and the paper's figure.
    Lines have their keys and labels; of a table's further blocks, also the data set.
    """
    rows = [
        {
            "table": table.name,
            "data_set": block.title,
            "line": key,
            "label": line.label,
            "metric": metric,
            "measured": found.mean(metric),
            "half_interval": found.half(metric),
            "runs": len(found.runs),
            "published": block.published(metric).get(key),
        }
        for table in tables
        for block in table.shown(measured)
        for key, (line, found) in block.lines.items()
        for metric in table.metrics
    ]
    return pd.DataFrame(rows).to_csv(index=False)


def _written(metric: str, value: float) -> str:
    """A figure with the paper's number of decimals, sizes in MB."""
    family = re.split(r"[._]", metric)[0]
    if family not in DECIMALS:
        return shown_as(metric).write(value)
    return decimal(value / 1e6 if family == "size" else value, DECIMALS[family])


def _escaped(text: str) -> str:
    """For LaTeX; powers of numbers are set in math mode."""
    return POWER.sub(r"$^{\1}$", text.translate(ESCAPES))
