"""Exports tables: LaTeX for an article, Markdown, CSV and JSON."""

import re
from collections.abc import Sequence

import pandas as pd

from reports.comparison import conditions_of, marked, shown_as, usual
from reports.paper_tables import Measured, PaperTable, Shown, figure_table
from reports.tables import Rows, Table, decimal

DECIMALS = {"ssim": 3, "lpips": 3, "frame": 2, "size": 1}
"""Decimals of the paper where pages have others, by the first part of a metric's name."""

ESCAPES = str.maketrans(
    {
        **{sign: f"\\{sign}" for sign in "&%$#_{}"},
        **{sign: f"{{{sign}}}" for sign in "[]"},
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


def exported(table: Table, figures: pd.DataFrame, form: str) -> str:
    """A table as `markdown` or `latex`, or its `figures` as `csv` or `json`."""
    if form == "markdown":
        return table.section()
    if form != "latex":
        return _for_programs(figures, form)
    rows = [
        [re.sub(r"^\*\*(.*)\*\*$", lambda x: MARKS[0] % x[1], escaped(text)) for text in line]
        for line in table.lines
    ]
    sides = "".join("lr"[table.right(column)] for column in range(len(table.columns)))
    return _tabular(f"{table.title}.", "", sides, table.columns, rows)


def exported_tables(tables: Sequence[PaperTable], measured: Measured, form: str) -> str:
    """Tables that experiments declare, in the same forms.

    In LaTeX they have as many decimals as in the paper, and the second best of at least three
    figures is underlined.
    """
    if form == "latex":
        return "\n".join(_latex(table, measured) for table in tables)
    blocks = [block for table in tables for block in table.shown(measured)]
    if form == "markdown":
        return "\n".join(figure_table(block).section() for block in blocks)
    return _for_programs(_figures(blocks), form)


def _for_programs(figures: pd.DataFrame, form: str) -> str:
    if form == "csv":
        return figures.to_csv(index=False)
    return figures.to_json(orient="records", indent=1, double_precision=15) + "\n"


def _latex(table: PaperTable, measured: Measured) -> str:
    blocks = table.shown(measured)
    runs = [run for block in blocks for line in block.measured.values() for run in line.runs]
    where = f"{conditions_of(runs)}." if runs else ""
    caption = f"{table.title}. {where[:1].upper()}{where[1:]}"
    heads = ["", *(shown_as(metric).heading for metric in table.metrics)]
    sides = f"l{'r' * len(table.metrics)}"
    rows = [row for block in blocks for row in _rows(block)]
    return _tabular(caption.strip(), table.name, sides, heads, rows)


def _tabular(
    caption: str,
    name: str,
    sides: str,
    heads: Sequence[str],
    rows: Rows,
) -> str:
    """A table for the package booktabs; the cells of `rows` are LaTeX already."""
    return pd.DataFrame(rows, columns=list(map(escaped, heads))).to_latex(
        index=False,
        caption=escaped(caption),
        label=f"tab:{name}" if name else None,
        column_format=sides,
        escape=False,
    )


def _rows(block: Shown) -> list[list[str]]:
    """The cells of a block; a further one is below a rule, and labels also have its data set."""
    lines, metrics = list(block.measured.values()), block.table.metrics
    columns = [marked(lines, metric, MARKS, _written) for metric in metrics]
    where = f" ({block.title})" if block.title else ""
    rows = [
        [escaped(line.label + where), *((text or "--").replace("±", r"$\pm$") for text in row)]
        for line, *row in zip(lines, *columns, strict=True)
    ]
    if block.title:
        rows[0][0] = f"\\midrule\n{rows[0][0]}"
    return rows


def _figures(blocks: Sequence[Shown]) -> pd.DataFrame:
    """One figure per row, in the units of `steerbench results`.

    A row has the measured mean, the number of runs, half the 95 % interval, and the paper's figure.
    Lines have their keys and labels; of a table's further blocks, also the data set.
    """
    return pd.DataFrame(
        {
            "table": block.table.name,
            "data_set": block.title,
            "line": key,
            "label": block.lines[key].label,
            "metric": metric,
            "measured": found.mean(metric),
            "half_interval": found.half(metric),
            "runs": len(found.runs),
            "published": block.published(metric).get(key),
        }
        for block in blocks
        for key, found in block.measured.items()
        for metric in block.table.metrics
    )


def _written(metric: str, value: float) -> str:
    """A figure with the paper's number of decimals, sizes in MB."""
    family = re.split(r"[._]", metric)[0]
    if family not in DECIMALS:
        return usual(metric, value)
    return decimal(value / 1e6 if family == "size" else value, DECIMALS[family])


def escaped(text: str) -> str:
    """Text for LaTeX; powers of numbers are set in math mode."""
    return POWER.sub(r"$^{\1}$", text.translate(ESCAPES))
