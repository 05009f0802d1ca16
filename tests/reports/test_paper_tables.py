"""The paper's tables: what their files hold, measured figures, and distances beside published."""

from __future__ import annotations

from dataclasses import replace

import pytest
from omegaconf import OmegaConf

from reports.claims import UNKNOWN
from reports.paper_tables import (
    DATA_SETS,
    FIRST,
    Line,
    PaperTable,
    comparisons,
    distance_table,
    figure_table,
    paper_tables,
    section,
)
from reports.publish import markdown
from reports.runs import Repeated, Run
from reports.tables import ABSENT, QUALITY
from sweeps.overrides import CONFIGS
from tests.reports.conftest import TABLES, changed, elsewhere

_, SECOND = DATA_SETS
BOTH = {table.name: table for table in paper_tables(CONFIGS / "experiment", [FIRST, SECOND])}
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
        assert {table.reference} <= {"", *labels}
        for line in table.lines:
            assert set(line.published) <= {*table.metrics, "frame_ms"}, line.label
        for claim in table.claims:
            assert set(claim.lines) <= set(labels), claim
        for metric in table.metrics:
            assert metric in METRICS or metric.startswith("stage_ms."), metric


def test_milliseconds_follow_from_published_frames_per_second():
    fast = next(line for line in TABLES["table1"].lines if line.label == "PlenOctree")
    assert fast.published["frame_ms"] == pytest.approx(1000 / 167.7)


@pytest.mark.parametrize("name", TABLES)
def test_a_second_data_set_has_its_figures_in_a_block_if_the_paper_has_any(name):
    (alone,) = (x for x in paper_tables(CONFIGS / "experiment", [SECOND]) if x.name == name)
    first, both = TABLES[name], BOTH[name]
    assert both.lines == first.lines
    assert [block.data_set for block in both.beside] == [SECOND] * (name in ("table1", "table2"))
    assert alone.data_set == (SECOND if both.beside else "")
    assert [line.label for line in alone.lines] == [line.label for line in first.lines]
    assert [line.job for line in alone.lines] == [line.job for line in first.lines]
    for block in both.beside:
        figures = {f"{line.label} ({SECOND})": line.published for line in alone.lines}
        assert all(line.published == figures[line.label] for line in block.lines)
        assert block.published_on == alone.published_on != first.published_on
    if not both.beside:
        assert not any(line.published for line in alone.lines)


def test_both_halves_make_claims_each_with_its_own_figures(run):
    """The paper gives PSNR, and FPS, of both lines on both data sets."""
    lines = ["SteerNeRF, half precision", "Instant-NGP"]
    marks = ("", f" ({SECOND})")
    measured = [Repeated(f"{line}{mark}", [run]) for mark in marks for line in lines]
    found = [
        x
        for x in comparisons(BOTH["table1"], measured)
        if x.claim.metric == "psnr" and x.verdict != UNKNOWN
    ]
    assert [(x.table, x.smaller, x.larger) for x in found] == [
        ("Table 1", *lines),
        (f"Table 1, {SECOND}", *lines),
    ]
    assert [x.paper for x in found] == pytest.approx([32.79 - 31.60, 28.77 - 28.65])


def test_what_stands_for_a_line_that_was_not_measured_has_its_figures_and_says_why(run, tmp_path):
    lines = [
        Repeated("SteerNeRF, half precision", [], ["failed: no bfloat16"]),
        Repeated("SteerNeRF, fp32", [run]),
        Repeated("Instant-NGP", [run]),
    ]
    found = [x for x in comparisons(TABLES["table1"], lines) if x.claim.metric == "psnr"]
    (one,) = (x for x in found if x.verdict != UNKNOWN)
    assert (one.smaller, one.larger) == ("SteerNeRF, fp32", "Instant-NGP")
    assert one.paper == pytest.approx(32.79 - 31.60)
    assert {x.claim.says for x in found if "int8" in x.claim.says} == {
        "PSNR lost by uncalibrated int8 against fp32"
    }
    text = markdown(section(TABLES["table1"], lines), tmp_path)
    assert "| SteerNeRF, half precision" not in text
    assert "| SteerNeRF, fp32 | +0.00 (-1.19) |" in text
    why = "failed: no bfloat16"
    assert f'- "SteerNeRF, fp32" stands for "SteerNeRF, half precision" ({why}).' in text


@pytest.mark.parametrize("name", TABLES)
def test_the_lines_of_a_table_take_every_value_of_its_grid_and_no_other(name):
    experiment = OmegaConf.load(CONFIGS / "experiment" / f"{name}.yaml")
    jobs = [line.job for block in TABLES[name].blocks for line in block.lines]
    for setting, values in experiment.hydra.sweeper.params.items():
        usual, *others = values.split(",")
        assert {usual, *(job[setting] for job in jobs if setting in job)} == {usual, *others}


def test_a_section_shows_the_distances_of_its_lines(run, tmp_path):
    table = TABLES["table5"]
    lines = [Repeated(line.label, [run]) for block in table.blocks for line in block.lines]
    text = markdown(section(table, lines), tmp_path)
    assert "| measured |" not in text  # its lines are no methods
    assert "| here (paper) | PSNR, dB ↑ | SSIM ↑ | LPIPS vgg ↓ |" in text
    assert "| without joint training | 30.46 |" in text
    assert "| with joint training | +0.00 (+1.07) |" in text


def test_a_cell_has_the_distance_to_the_reference_here_and_in_the_paper(run):
    other = changed(run, {"psnr": 29.0, "frame_ms": 6.0})
    measured = {
        label: Repeated(label, [changed(each, {}, seed=seed) for seed in (0, 1)])
        for label, each in (("here", run), ("elsewhere", other))
    }
    published = {"psnr": 30.0, "frame_ms": 1.2 * 9.98, "size_bytes.total": 5e6}
    lines = [TABLE.lines[0], replace(TABLE.lines[1], published=published)]
    table = replace(TABLE, reference="here", lines=lines)
    first, line = distance_table(table, measured).lines
    assert first == ("here", "30.46", "12.0", "8.00")
    assert line == ("elsewhere", "-1.46 (-1.00)", "×0.50 (×1.20)", "×1.00")
    first, line = distance_table(table, {}).lines
    assert first == ("here", ABSENT, ABSENT)
    assert line == ("elsewhere", f"{ABSENT} (-1.00)", f"{ABSENT} (×1.20)")
    heads = ("here (paper)", "PSNR, dB ↑", "ms / frame ↓")  # no size has a distance
    assert distance_table(table, {}).columns == heads


def test_a_cell_of_figures_is_measured_or_absent(run):
    shown = figure_table(TABLE, {"here": Repeated("here", [run], ["seed 1 failed"])})
    labels = ("PSNR, dB ↑", "ms / frame ↓", "model, MB ↓", "other, ms ↓")
    assert shown.columns == ("measured", *labels)
    assert shown.lines[0] == ("here: seed 1 failed", "30.46", "12.0", ABSENT, "8.00")
    assert shown.lines[1] == ("elsewhere", *[ABSENT] * 4)


def test_the_second_of_two_has_no_mark_beside_two_of_another_machine(run):
    table = replace(TABLE, lines=[Line(name, {"method": name}) for name in "abcd"])
    runs = {name: changed(run, {"psnr": psnr}) for psnr, name in enumerate("abcd", 1)}
    runs |= {name: elsewhere(runs[name]) for name in "cd"}
    shown = figure_table(table, {name: Repeated(name, [of]) for name, of in runs.items()})
    assert [line[1] for line in shown.lines] == ["1.00", "**2.00**", "3.00", "**4.00**"]


def test_the_best_is_bold_and_the_second_of_three_italic(run):
    table = replace(TABLE, lines=[Line(name, {"method": name}) for name in "abc"])
    psnr = {"a": 1.0, "b": 3.0, "c": 2.0}
    of = {name: Repeated(name, [changed(run, {"psnr": value})]) for name, value in psnr.items()}
    cells = [line[1] for line in figure_table(table, of).lines]
    assert cells == ["1.00", "**3.00**", "*2.00*"]
    two = figure_table(table, {name: of[name] for name in "ab"})
    assert [line[1] for line in two.lines] == ["1.00", "**3.00**", ABSENT]


def test_a_section_says_on_what_and_what_to_mind(run, tmp_path):
    lines = [Repeated("here", [changed(run, {"psnr": 31.0})]), Repeated("elsewhere", [run])]
    text = markdown(section(TABLE, lines), tmp_path)
    assert text.startswith("## Table 9: What is shown")
    assert "Paper: Chair." in text
    assert f"scene {run.facts['scene']}" in text
    assert "- Mind this." in text
    assert "- lpips_alex: n/a. no weights were found" in text
