"""Tables of measured figures, and distances beside published ones."""

from dataclasses import replace

import pytest

from reports.claims import UNKNOWN, Claim
from reports.paper_tables import (
    Line,
    Measured,
    PaperTable,
    Place,
    Shown,
    comparisons,
    distance_table,
    figure_table,
    section,
)
from reports.publish import markdown
from reports.runs import Repeated, Run
from reports.tables import ABSENT
from tests.reports.conftest import TABLES, changed, elsewhere, measured_of

FIRST, SECOND = "NeRF-Synthetic", "Tanks & Temples"
LINES = {
    "a": Line("here", {"method": "a"}, {FIRST: {"psnr": 31.0, "frame_ms": 9.98}}),
    "b": Line("elsewhere", {"method": "b"}, {FIRST: {"size_bytes.total": 5e6}}),
}
METRICS = ["psnr", "frame_ms", "size_bytes.total", "stage_ms.other"]
TABLE = PaperTable(
    "table9",
    "What is shown",
    METRICS,
    LINES,
    [FIRST],
    {FIRST: "Chair", SECOND: "Barn"},
    number=9,
    notes=["Mind this."],
)


@pytest.fixture
def run(run) -> Run:
    """A run of known figures."""
    figures = {"psnr": 30.456, "frame_ms": 12.0, "stage_ms.other": 8.0}
    return changed(replace(run, rows=run.rows[run.rows["metric"].isin(figures)]), figures)


def block(table: PaperTable, measured: Measured) -> Shown:
    (only,) = table.shown(measured)
    return only


def of_two(*published: tuple[float, float]) -> PaperTable:
    """A table of two data sets; on both, the PSNR that the paper gives each line."""
    lines = {
        key: Line(line.label, {}, {FIRST: {"psnr": first}, SECOND: {"psnr": second}})
        for (key, line), (first, second) in zip(LINES.items(), published, strict=True)
    }
    return replace(TABLE, lines=lines, data_sets=[FIRST, SECOND])


def test_both_halves_make_claims_each_with_its_own_figures(run):
    table = replace(of_two((30.0, 28.0), (31.0, 28.5)), claims=[Claim("psnr", ["a", "b"], 0.1)])
    measured = {
        Place("table9", data_set, key): Repeated(line.label, [run])
        for data_set in (FIRST, SECOND)
        for key, line in LINES.items()
    }
    found = comparisons(table, measured)
    assert [(x.table, x.data_set, x.smaller, x.larger) for x in found] == [
        ("Table 9", "", "here", "elsewhere"),
        ("Table 9", SECOND, "here", "elsewhere"),
    ]
    assert [x.paper for x in found] == pytest.approx([1.0, 0.5])


def test_what_stands_for_a_line_that_was_not_measured_has_its_figures_and_says_why(run, tmp_path):
    table = TABLES["table1"]
    measured = measured_of(table, dict.fromkeys(("fp32", "ngp"), run))
    missing = {"bf16": Repeated(table.lines["bf16"].label, [], ["failed: no bfloat16"])}
    measured |= {Place("table1", FIRST, key): line for key, line in missing.items()}
    found = [x for x in comparisons(table, measured) if x.claim.metric == "psnr"]
    (one,) = (x for x in found if x.verdict != UNKNOWN)
    assert (one.smaller, one.larger) == ("SteerNeRF, fp32", "Instant-NGP")
    assert one.paper == pytest.approx(32.79 - 31.60)
    assert {x.claim.says for x in found if "int8" in x.claim.says} == {
        "PSNR lost by uncalibrated int8 against fp32"
    }
    text = markdown(section(table, measured), tmp_path)
    assert "| SteerNeRF, half precision" not in text
    assert "| SteerNeRF, fp32 | +0.00 (-1.19) |" in text
    why = "failed: no bfloat16"
    assert f'- "SteerNeRF, fp32" stands for "SteerNeRF, half precision" ({why}).' in text


def test_a_section_shows_its_blocks_with_distances_and_says_what_to_mind(run, tmp_path):
    table = of_two((31.0, 31.0), (32.0, 32.0))
    measured = {Place("table9", x, "a"): Repeated("here", [run]) for x in (FIRST, SECOND)}
    first, second = markdown(section(table, measured), tmp_path).split(f"### {SECOND}")
    for text, where in ((first, "Chair"), (second, "Barn")):
        assert f"Paper: {where}." in text
        assert "| measured |" not in text  # its lines are no methods
        assert "| here (paper) | PSNR, dB ↑ |" in text
        assert "| here | 30.46 |" in text
        assert f"| elsewhere | {ABSENT} (+1.00) |" in text
        assert f"scene {run.facts['scene']}" in text
        assert "- lpips_alex: n/a. no weights were found" in text
    assert first.startswith("## Table 9: What is shown")
    assert "- Mind this." in first
    assert "Mind this." not in second
    alone = {place: line for place, line in measured.items() if place.block == FIRST}
    assert SECOND not in markdown(section(table, alone), tmp_path)


def test_a_cell_has_the_distance_to_the_reference_here_and_in_the_paper(run):
    other = changed(run, {"psnr": 29.0, "frame_ms": 6.0})
    measured = {
        Place("table9", FIRST, key): Repeated(
            LINES[key].label, [changed(each, {}, seed=seed) for seed in (0, 1)]
        )
        for key, each in (("a", run), ("b", other))
    }
    published = {"psnr": 30.0, "frame_ms": 1.2 * 9.98, "size_bytes.total": 5e6}
    lines = {**LINES, "b": replace(LINES["b"], published={FIRST: published})}
    table = replace(TABLE, lines=lines, reference="a")
    first, line = distance_table(block(table, measured)).lines
    assert first == ("here", "30.46", "12.0", "8.00")
    assert line == ("elsewhere", "-1.46 (-1.00)", "×0.50 (×1.20)", "×1.00")
    first, line = distance_table(block(table, {})).lines
    assert first == ("here", ABSENT, ABSENT)
    assert line == ("elsewhere", f"{ABSENT} (-1.00)", f"{ABSENT} (×1.20)")
    heads = ("here (paper)", "PSNR, dB ↑", "ms / frame ↓")  # no size has a distance
    assert distance_table(block(table, {})).columns == heads
    table = replace(table, reference="b")
    assert [row[0] for row in distance_table(block(table, measured)).lines] == ["elsewhere", "here"]


def test_a_cell_of_figures_is_measured_or_absent(run):
    measured = {Place("table9", FIRST, "a"): Repeated("here", [run], ["seed 1 failed"])}
    shown = figure_table(block(TABLE, measured))
    labels = ("PSNR, dB ↑", "ms / frame ↓", "model, MB ↓", "other, ms ↓")
    assert shown.columns == ("measured", *labels)
    assert shown.lines[0] == ("here: seed 1 failed", "30.46", "12.0", ABSENT, "8.00")
    assert shown.lines[1] == ("elsewhere", *[ABSENT] * 4)


def test_the_best_is_bold_and_the_second_of_three_italic_on_each_machine(run):
    table = replace(TABLE, lines={name: Line(name, {"method": name}) for name in "abcde"})
    runs = {name: changed(run, {"psnr": psnr}) for psnr, name in enumerate("abcde", 1)}
    runs |= {name: elsewhere(runs[name]) for name in "cde"}
    shown = figure_table(block(table, measured_of(table, runs)))
    cells = [line[1] for line in shown.lines]
    assert cells == ["1.00", "**2.00**", "3.00", "*4.00*", "**5.00**"]
