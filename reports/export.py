"""Exports the paper's tables: LaTeX for an article, CSV for a spreadsheet."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial

import pandas as pd

from reports.comparison import conditions_of, marked, metric_format
from reports.paper_tables import Lines, PaperTable
from reports.runs import Repeated
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

SETTING = re.compile(r"[A-Z] = \d+(\^\d+)?")
"""A label such as "T = 2^19", which is set in math mode."""

MARKS = (r"\textbf{%s}", r"\underline{%s}")
"""LaTeX for the best and the second-best figure of a column."""


def latex(tables: Sequence[PaperTable], measured: Lines) -> str:
    """All tables as LaTeX, for the package booktabs, with as many decimals as in the paper.

    Among figures under the same conditions, the best of a column is bold and, of at least three,
    the second best is underlined; figures that look the same share a rank.
    """
    return "\n".join(_latex(table, measured.get(table.name, ())) for table in tables)


def _latex(table: PaperTable, lines: Sequence[Repeated]) -> str:
    known = {line.label: line for line in lines}
    rows, *beyond = (_rows(block, known) for block in table.shown(known))
    runs = [run for line in lines for run in line.runs]
    caption = f"{_escaped(table.title)}. " + (f"{_escaped(conditions_of(runs))}. " if runs else "")
    text = pd.DataFrame(
        sum(beyond, rows),
        columns=["", *(_escaped(metric_format(metric)[0]) for metric in table.metrics)],
    ).to_latex(
        index=False,
        column_format="l" + "r" * len(table.metrics),
        caption=caption.strip(),
        label=f"tab:{table.name}",
    )
    for further in beyond:  # a rule before the lines beyond the paper
        first = " & ".join(further[0])
        text = text.replace(first, f"\\midrule\n{first}", 1)
    return text


def _rows(block: PaperTable, known: Mapping[str, Repeated]) -> list[list[str]]:
    lines = block.measured(known)
    columns = [marked(lines, metric, MARKS, partial(_written, metric)) for metric in block.metrics]
    return [
        [_escaped(line.label), *((text or "--").replace("±", r"$\pm$") for text in row)]
        for line, *row in zip(lines, *columns, strict=True)
    ]


def csv(tables: Sequence[PaperTable], measured: Lines) -> str:
    """All tables as CSV, one figure per row, in the units of `steerbench results`.

    A row has the measured mean, the number of runs, half the 95 % interval, and the paper's figure.
    """
    rows = []
    for table in tables:
        known = {line.label: line for line in measured.get(table.name, ())}
        for block in table.shown(known):
            for line, found in zip(block.lines, block.measured(known), strict=True):
                rows += [
                    {
                        "table": table.name,
                        "line": line.label,
                        "metric": metric,
                        "measured": found.mean(metric),
                        "half_interval": found.half(metric),
                        "runs": len(found.runs),
                        "published": line.published.get(metric),
                    }
                    for metric in table.metrics
                ]
    return pd.DataFrame(rows).to_csv(index=False)


def _written(metric: str, value: float) -> str:
    """A figure with the paper's number of decimals, sizes in MB."""
    family = re.split(r"[._]", metric)[0]
    if family not in DECIMALS:
        return metric_format(metric)[1](value)
    return decimal(value / 1e6 if family == "size" else value, DECIMALS[family])


def _escaped(text: str) -> str:
    if SETTING.fullmatch(text):
        return "$" + re.sub(r"\^(\d+)", r"^{\1}", text) + "$"
    return text.translate(ESCAPES)
