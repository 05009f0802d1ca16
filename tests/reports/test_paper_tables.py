"""The paper's tables: what their files hold, and cells of measured beside published figures."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest
from omegaconf import OmegaConf

from reports.paper_tables import ABSENT, Line, PaperTable, section, with_published
from reports.publish import markdown
from reports.runs import Repeated, Run
from reports.tables import QUALITY
from reports.trends import Trend
from sweeps.overrides import CONFIGS
from tests.reports.conftest import TABLES, changed

METRICS = {*QUALITY, "fps", "frame_ms", "size_bytes.total", "work.samples"}
TABLE = PaperTable(
    "table9",
    "What is shown",
    "Chair",
    ["psnr", "frame_ms", "size_bytes.total", "stage_ms.other"],
    [
        Line("here", {"method": "a"}, {"psnr": 31.0, "frame_ms": 9.98}),
        Line("elsewhere", {"method": "b"}, {"size_bytes.total": 5e6}),
    ],
    ["Mind this."],
)


@pytest.fixture
def run(run: Run) -> Run:
    """A run of known figures."""
    figures = {"psnr": 30.456, "frame_ms": 12.0, "stage_ms.other": 8.0}
    return changed(replace(run, rows=run.rows[run.rows["metric"].isin(figures)]), figures)


def test_the_experiments_declare_the_six_tables_of_the_paper():
    assert list(TABLES) == [f"table{number}" for number in range(1, 7)]
    for table in TABLES.values():
        labels = [line.label for line in table.lines]
        assert len(set(labels)) == len(labels)
        for line in table.lines:
            assert set(line.published) <= set(table.metrics), line.label
        for trend in table.trends:
            assert set(trend.rising) <= set(labels), trend.rising
        for metric in table.metrics:
            assert metric in METRICS or metric.startswith("stage_ms."), metric


@pytest.mark.parametrize("name", [name for name, table in TABLES.items() if table.beyond])
def test_the_block_beyond_the_paper_has_its_lines_and_trends_but_no_published_figure(name):
    first, second = TABLES[name].blocks
    own = [line for line in first.lines if "method" not in line.job]
    assert [line.job for line in second.lines] == [
        {**line.job, "method": "steernerf_lean"} for line in own
    ]
    assert not any(line.published for line in second.lines)
    labels = {line.label for line in (*first.lines, *second.lines)}
    assert len(labels) == len(first.lines) + len(second.lines)
    assert len(second.trends) == len(first.trends)
    for one, other in zip(first.trends, second.trends, strict=True):
        assert set(other.rising) <= labels
        assert one.rising != other.rising


@pytest.mark.parametrize("name", TABLES)
def test_the_lines_of_a_table_take_every_value_of_its_grid_and_no_other(name):
    experiment = OmegaConf.load(CONFIGS / "experiment" / f"{name}.yaml")
    jobs = [line.job for block in TABLES[name].blocks for line in block.lines]
    for setting, values in experiment.hydra.sweeper.params.items():
        usual, *others = values.split(",")
        assert {usual, *(job[setting] for job in jobs if setting in job)} == {usual, *others}


def test_a_section_shows_both_blocks_each_with_its_trends(run, tmp_path):
    table = TABLES["table5"]
    lines = [Repeated(line.label, [run]) for block in table.blocks for line in block.lines]
    text = markdown(section(table, lines), tmp_path)
    paper, beyond = text.split("### Beyond the paper: steernerf_lean")
    assert "PSNR, dB: without joint training < with joint training |" in paper
    assert "(steernerf_lean)" not in paper
    shown = "without joint training (steernerf_lean) < with joint training (steernerf_lean)"
    assert f"PSNR, dB: {shown} |" in beyond
    assert "| measured |" in beyond
    assert "/ 33.05" in paper
    assert "33.05" not in beyond.partition("- ")[0]


def test_a_cell_is_measured_published_and_their_difference(run):
    shown = with_published(TABLE, {"here": Repeated("here", [run])})
    assert shown.columns == (
        "measured / paper / difference",
        *("PSNR, dB ↑", "ms / frame ↓", "model, MB ↓", "other, ms ↓"),
    )
    assert shown.lines[0] == (
        "here",
        "30.46 / 31.00 / -0.54",
        "12.0 / 10.0 / +2.0",
        ABSENT,
        f"8.00 / {ABSENT}",
    )
    assert shown.lines[1] == ("elsewhere", ABSENT, ABSENT, f"{ABSENT} / 5.00", ABSENT)


def test_a_stage_holds_the_stages_inside_it(run):
    inside = run.rows[run.rows["metric"] == "stage_ms.other"]
    inside = inside.assign(metric="stage_ms.other/march", value=3.0)
    whole = replace(run, rows=pd.concat([run.rows, inside]))
    shown = with_published(TABLE, {"here": Repeated("here", [whole])})
    assert shown.lines[0][4] == f"11.00 / {ABSENT}"


def test_several_seeds_give_their_mean_and_its_interval(run):
    shown = with_published(
        TABLE, {"here": Repeated("here", [changed(run, {"psnr": x}) for x in (29.0, 31.0)])}
    )
    # Half of a t-interval of two values that are 2 apart: t(0.975, 1) * sqrt(2) / sqrt(2).
    assert shown.lines[0][1] == "30.00 ± 12.71 / 31.00 / -1.00"
    assert shown.lines[0][2] == "12.0 / 10.0 / +2.0"


def test_the_best_is_bold_and_the_second_of_three_italic(run):
    table = replace(TABLE, lines=[Line(name, {"method": name}) for name in "abc"])
    psnr = {"a": 1.0, "b": 3.0, "c": 2.0}
    of = {name: Repeated(name, [changed(run, {"psnr": value})]) for name, value in psnr.items()}
    cells = [line[1] for line in with_published(table, of).lines]
    assert cells == ["1.00", "**3.00**", "*2.00*"]
    two = with_published(table, {name: of[name] for name in "ab"})
    assert [line[1] for line in two.lines] == ["1.00", "**3.00**", ABSENT]


def test_a_section_says_on_what_and_what_to_mind_and_whether_trends_hold(run, tmp_path):
    trend = Trend("psnr", ["elsewhere", "here"])
    lines = [Repeated("here", [changed(run, {"psnr": 31.0})]), Repeated("elsewhere", [run])]
    published = [TABLE.lines[0], replace(TABLE.lines[1], published={"psnr": 30.4})]
    parts = section(replace(TABLE, lines=published, trends=[trend]), lines)
    text = markdown(parts, tmp_path)
    assert text.startswith("## Table 9: What is shown")
    assert "Paper: Chair." in text
    assert f"scene {run.facts['scene']}" in text
    assert "| PSNR, dB: elsewhere < here | +0.60 | " in text
    assert "- Mind this." in text
    assert "- lpips_alex: n/a. no weights were found" in text
