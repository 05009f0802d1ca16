"""The page about the paper's tables: its pictures, its curves, its outliers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import pytest

from reports import figures
from reports.images import Picture
from reports.outliers import Outlier
from reports.paper_page import PAGE, _curves, write_paper_page
from reports.runs import Repeated, Run
from tests.reports.conftest import TABLES


def of(run: Run, label: str) -> Repeated:
    """`run` as that of a line."""
    return Repeated(label, [replace(run, label=label)])


def test_every_line_that_is_shown_in_a_figure_is_one_of_the_tables():
    blocks = [block for table in TABLES.values() for block in table.blocks]
    lines = {(block.name, line.label) for block in blocks for line in block.lines}
    shown = [entry["lines"] for entry in (*PAGE["plots"], *PAGE["images"]) if "lines" in entry]
    assert shown
    assert {tuple(line) for entry in shown for line in entry.values()} <= lines
    assert all(set(plot.get("tables", ())) <= {name for name, _ in lines} for plot in PAGE["plots"])


def test_the_page_has_every_table_and_every_figure(run, tmp_path):
    lines = {
        name: [of(run, line.label) for block in table.blocks for line in block.lines]
        for name, table in TABLES.items()
    }
    found = [Outlier(run.key, "13 dB among 30s"), Outlier("another", "not of this page")]
    page = write_paper_page([*TABLES.values()], lines, found, tmp_path)
    text = page.read_text()
    shown = re.findall(r"!\[[^]]*\]\((.+?)\)", text)
    assert len(shown) == 6
    assert {page.parent / name for name in shown} == set((tmp_path / "pictures").iterdir())
    assert all(f"## Table {number}" in text for number in range(1, 7))
    assert text.count(f"{run.key}  steerbench run method=offset") == 1
    assert "## Outliers: runs that look broken" in text
    assert "13 dB among 30s" in text
    assert "not of this page" not in text
    html = (tmp_path / "report.html").read_text()
    assert html.count("<svg") == 4
    assert html.count('<div class="frame"') == 2


def test_points_of_a_curve_are_not_plotted_against_cost(run, tmp_path, monkeypatch):
    table = TABLES["table6"]
    lines = [of(run, line.label) for line in (*table.lines, *table.marks.values())]
    drawn: list[str] = []
    real = figures.quality_plot

    def watched(shown: Sequence[Repeated], metric: str) -> Picture:
        drawn.extend(line.label for line in shown)
        return real(shown, metric)

    monkeypatch.setattr(figures, "quality_plot", watched)
    write_paper_page([table], {"table6": lines}, [], tmp_path)
    assert drawn == [f"SteerNeRF, {line.label}" for line in table.lines]


def test_a_page_of_nothing_still_says_what_is_missing(tmp_path):
    lines = {"table5": [Repeated("with joint training", [], ["not measured yet"])]}
    text = write_paper_page([*TABLES.values()], lines, [], tmp_path).read_text()
    assert "| with joint training: not measured yet | – / 33.05 |" in text
    assert "![" not in text
    assert "Outliers" not in text


def test_a_curve_has_a_point_for_every_scored_frame_and_hollow_ones_for_cold(run, tmp_path, drawn):
    frames = run.frames.copy()
    frames.loc[0, "phase"] = "cold"
    frames.loc[3, "psnr"] = float("nan")
    figures.quality_over_frames([replace(run, read_frames=lambda: frames)], tmp_path / "curve.png")
    curve, cold = drawn[0].axes[0].lines
    assert list(curve.get_xdata()) == [0, 1, 2, 4, 5]
    assert list(cold.get_xdata()) == [0]


def test_a_mark_stands_where_its_line_is_in_quality_and_cost(run, tmp_path, drawn):
    lines = [of(run, "measured"), Repeated("missing", [])]
    figures.quality_against(lines, "size_bytes.total", tmp_path / "marks.png")
    (mark,) = drawn[0].axes[0].lines
    assert mark.get_xydata().tolist() == [[104e-6, run.values["psnr"]]]


@pytest.mark.parametrize(("of_method", "of_budget"), [(None, 80), (80, 7)])
def test_a_curve_has_a_point_for_every_measured_share(of_method, of_budget, run, tmp_path, drawn):
    table = TABLES["table5"]
    made_of = {"config": {"method": {"steps": of_method}}}
    budget = {"renderer_steps": of_budget}
    trained = replace(run, record={**run.record, "budget": budget, "made_of": made_of})
    first, second = table.lines
    halves = [table.marks[line.label, 0.5].label for line in table.lines]
    quarter = table.marks[first.label, 0.25].label
    measured = [of(trained, label) for label in (first.label, second.label, *halves, quarter)]
    curves = list(_curves(table, {"table5": measured}))
    assert [(curve.label, list(curve.points)) for curve in curves] == [
        (first.label, [20, 40, 80]),
        (second.label, [40, 80]),
    ]
    figures.quality_over_training(curves, tmp_path / "curves.png")
    (axes,) = drawn[0].axes
    assert axes.get_title() == "Table 5"
    for line, curve in zip(axes.lines, curves, strict=True):
        assert list(line.get_xdata()) == list(curve.points)
        assert set(line.get_ydata()) == {run.values["psnr"]}
