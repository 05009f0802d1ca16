"""The page about the paper's tables, and the plots of all pages."""

import re
from dataclasses import replace

import pytest

from reports import figures
from reports.lines import Lines
from reports.paper_page import PAGE, write_paper_page
from reports.paper_tables import Line, PaperTable, Place
from reports.runs import Repeated, Run
from sweeps.tables import chosen
from tests.reports.conftest import TABLES, changed, measured_of, shifted


def of(run: Run, label: str) -> Repeated:
    return Repeated(label, [replace(run, label=label)])


def test_every_line_that_is_shown_in_a_figure_is_one_of_the_tables():
    lines = {(table.name, key) for table in TABLES.values() for key in table.lines}
    shown = [entry["lines"] for entry in (*PAGE["plots"], *PAGE["images"]) if "lines" in entry]
    named = [(table, str(key)) for x in shown for table, key in x.values()]
    assert len(named) > len(shown) > 3
    assert {*named} <= lines


def test_the_page_has_every_table_and_every_figure(run, tmp_path):
    measured = {}
    for table in TABLES.values():
        measured |= measured_of(table, dict.fromkeys(table.lines, run))
    page = write_paper_page([*TABLES.values()], measured, tmp_path)
    text = page.read_text()
    shown = re.findall(r"!\[[^]]*\]\((.+?)\)", text)
    assert len(shown) == 6
    assert {page.parent / name for name in shown} == set((tmp_path / "pictures").iterdir())
    assert all(f"## Table {number}" in text for number in range(1, 7))
    assert text.count(f"{run.key}  steerbench run method=offset") == 1
    html = (tmp_path / "report.html").read_text()
    assert html.count("<svg") == 4
    assert html.count('<div class="frame"') == 2


def test_a_method_has_one_mark_at_its_first_measured_line_and_an_added_one_is_in_all_figures(
    run, tmp_path, monkeypatch
):
    (table,) = chosen("table1", methods=["x"])
    measured = measured_of(table, dict.fromkeys(table.lines.keys() - {"bf16"}, run))
    drawn = []
    real = figures.quality_plot

    def watched(shown, metric):
        drawn.append([line.label for line in shown])
        return real(shown, metric)

    monkeypatch.setattr(figures, "quality_plot", watched)
    measured |= measured_of(TABLES["table5"], dict.fromkeys(("frozen", "joint"), run))
    page = write_paper_page([table, TABLES["table5"]], measured, tmp_path)
    methods = ["NeRF", "NSVF", "KiloNeRF", "PlenOctree", "DIVeR", "Instant-NGP", "3D Gaussians"]
    assert drawn == 2 * [[*methods, "SteerNeRF", "x"]]
    text = page.read_text()
    assert "![Ground truth, Instant-NGP, SteerNeRF, x; a detail" in text
    assert "![Ground truth, without joint training, with joint training; a detail" in text


def test_findings_come_first_all_comparisons_last(run, tmp_path):
    table, seeds = TABLES["table6"], range(3)
    measured = {
        Place("table6", table.data_sets[0], key): Repeated(
            line.label,
            [shifted(run, 0.1 * place + 0.01 * seed * place, seed=seed) for seed in seeds],
        )
        for place, (key, line) in enumerate(reversed(table.lines.items()))
    }
    text = write_paper_page([table], measured, tmp_path).read_text()
    before, after = text.split("## The tables")
    says = "PSNR lost by a hash table of 2^16 against 2^19"
    assert f"| **{says} (dB)** | +0.02 | +0.11 | " in before
    assert "Of all 4 comparisons, 2 have an interval" in before  # sizes are computed
    found = after.split("## All comparisons")[1]
    assert "| Table 6, PSNR, dB: T = 2^14 < T = 2^16 | +0.33 | +0.11 |" in found
    assert "| Table 6, PSNR, dB: T = 2^16 ≈ T = 2^19 | +0.02 | +0.11 |" in found


def test_a_page_of_nothing_still_says_what_is_missing(tmp_path):
    lines = [Repeated("with joint training", [], ["not measured yet"])]
    measured = {Place("table5", TABLES["table5"].data_sets[0], "joint"): lines[0]}
    text = write_paper_page([*TABLES.values()], measured, tmp_path).read_text()
    assert "| with joint training: not measured yet | – (+1.07) |" in text
    assert "comparisons" not in text
    assert "![" not in text


def test_a_page_of_ones_own_table_has_its_title_figures_and_pictures(run, tmp_path):
    table = PaperTable(
        "mine", "My table", ["psnr"], {"a": Line("here", {}), "b": Line("there", {})}
    )
    text = write_paper_page([table], measured_of(table, {"a": run}), tmp_path).read_text()
    assert text.startswith("# My table\n")
    assert f"| here | {run.values['psnr']:.2f} |" in text
    assert "![Ground truth, here; a detail of each; error maps]" in text
    assert "aper" not in text


def test_a_curve_has_a_point_for_every_scored_frame_and_hollow_ones_for_cold(run, tmp_path, drawn):
    frames = run.frames.copy()
    frames.loc[0, "phase"] = "cold"
    frames.loc[3, "psnr"] = float("nan")
    figures.quality_over_frames([replace(run, read_frames=lambda: frames)], tmp_path / "curve.png")
    curve, cold = drawn[0].axes[0].lines
    assert list(curve.get_xdata()) == [0, 1, 2, 4, 5]
    assert list(cold.get_xdata()) == [0]


def test_a_setting_with_numbers_has_a_curve_for_each_choice_of_the_others(run, tmp_path, drawn):
    """Sorted by the number, with intervals; a line without it is dashed."""
    seeds = [shifted(run, by, seed=seed) for seed, by in enumerate((0.0, 1.0, 2.0))]
    lines = [*(of(run, "") for _ in range(4)), Repeated("", seeds), of(run, "field")]
    settings = {
        "method": [*5 * ["steernerf"], "ngp"],
        "steps": ["400", "20", "100", "20", "400", ""],
        "channels": ["6", "6", "6", "8", "8", ""],
    }
    figures.quality_along(Lines(lines, settings), "steps", tmp_path / "along.png")
    (axes,) = drawn[0].axes
    field, six, eight = axes.lines[0], *(bars.lines[0] for bars in axes.containers)
    assert [list(curve.get_xdata()) for curve in (six, eight)] == [[20, 100, 400], [20, 400]]
    assert field.get_linestyle() == "--"
    assert axes.get_xscale() == "log"
    (low, high) = axes.collections[-1].get_segments()[1][:, 1]
    assert high - low == pytest.approx(2 * lines[4].half("psnr"))
    legend = {text.get_text() for text in axes.get_legend().get_texts()}
    assert legend == {"field", "steernerf, channels=6", "steernerf, channels=8"}


def test_a_mark_stands_where_its_line_is_in_quality_and_cost(run, tmp_path, drawn):
    lines = [of(run, "measured"), Repeated("missing", [])]
    figures.quality_against(lines, "size_bytes.total", tmp_path / "marks.png")
    (mark,) = drawn[0].axes[0].lines
    assert mark.get_xydata().tolist() == [[104e-6, run.values["psnr"]]]


@pytest.mark.parametrize("count", [2, 11])
def test_lines_whose_settings_are_alike_or_unknown_have_names_however_many(
    run, tmp_path, drawn, count
):
    lines = [of(run, str(number)) for number in range(count)]
    for settings in ({}, {"method": count * ["ngp"]}):
        path = tmp_path / "marks.png"
        figures.quality_against(lines, "frame_ms", path, settings)
        assert len(drawn.pop().axes[0].texts) == count


def test_every_mark_has_its_name_beside_it_and_none_covers_another(run, tmp_path, drawn):
    """Even of marks that nearly coincide."""
    psnr = {"PlenOctree": 31.0, "DIVeR": 31.05, "3D Gaussians": 31.1, "Instant-NGP": 33.0}
    lines = [of(changed(run, {"psnr": value}), label) for label, value in psnr.items()]
    figures.quality_against(lines, "frame_ms", tmp_path / "marks.png")
    (axes,) = drawn[0].axes
    assert [text.get_text() for text in axes.texts] == list(psnr)
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(box.count_overlaps(boxes[:number]) for number, box in enumerate(boxes))
