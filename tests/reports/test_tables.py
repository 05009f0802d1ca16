"""Rows become tables whose every figure has its unit, its share or its `n/a`."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from reports import tables


def cells(table: tables.Table) -> dict[str, tuple[str, ...]]:
    """The figures of a table by the label of their line."""
    return {line[0]: line[1:] for line in table.lines}


def test_quality_names_the_lpips_network_and_shows_what_is_missing(rows):
    quality, _, _ = tables.run_tables(rows)
    assert quality.title == "Quality, mean of 7 frames"
    assert cells(quality) == {
        "PSNR, dB ↑": ("30.46", "29.50 – 31.50"),
        "SSIM ↑": ("0.9877", "0.9800 – 0.9900"),
        "LPIPS alex ↓": ("n/a", ""),
    }


def test_time_shows_every_stage_with_its_share_of_the_frame(rows):
    _, time, _ = tables.run_tables(rows)
    assert cells(time) == {
        "field": ("150.00", "75.0 %"),
        "other": ("50.00", "25.0 %"),
        "frame": ("200.00", "100.0 %"),
        "frame, p50": ("199.00", ""),
        "frame, p95": ("220.00", ""),
        "frame, p99": ("230.00", ""),
        "FPS": ("5.00", ""),
    }


def test_stages_that_do_not_add_up_to_the_frame_show(rows):
    rows.loc[rows["metric"] == "stage_ms.other", "value"] = 10.0
    assert cells(tables.run_tables(rows)[1])["frame"] == ("200.00", "80.0 %")


def test_memory_is_in_decimal_megabytes(rows):
    _, _, memory = tables.run_tables(rows)
    assert cells(memory) == {
        "table": ("25.00",),
        "model": ("25.20",),
        "peak, rendering": ("1,000.00",),
    }


def test_work_stands_beside_what_skipping_nothing_takes(rows):
    counted = {"samples": 57_461.4, "rays": 10_000.0, "rays.dense": 40_000.0, "frames": 1.5}
    more = [rows.iloc[0].copy() for _ in counted]
    for line, (name, value) in zip(more, counted.items(), strict=True):
        line["metric"], line["value"] = f"work.{name}", value
    _, _, work, _ = tables.run_tables(pd.concat([rows, pd.DataFrame(more)]))
    assert work.title == "Work of a frame"
    assert cells(work) == {
        "samples": ("57,461", "", ""),
        "rays": ("10,000", "40,000", "75.0 %"),
        "frames": ("1.5", "", ""),
    }


def test_cold_frames_stand_apart_and_are_called_so(rows, rows_with_cold):
    quality, time, cold_quality, cold_time, memory = tables.run_tables(rows_with_cold)
    assert [quality, time, memory] == tables.run_tables(rows)
    assert cold_quality.title == "Quality, cold, mean of 2 frames"
    assert cells(cold_quality)["PSNR, dB ↑"] == ("27.46", "26.50 – 28.50")
    assert cold_time.title == "Time of a frame, cold"
    assert cells(cold_time)["field"] == ("300.00", "75.0 %")


def test_a_run_of_cold_frames_alone_says_so(rows_with_cold):
    cold = rows_with_cold[rows_with_cold["phase"] != "steady"]
    titles = [table.title for table in tables.run_tables(cold)]
    assert titles == ["Quality, cold, mean of 2 frames", "Time of a frame, cold", "Memory"]


def test_the_headline_is_steady_where_a_run_has_steady_frames(rows, rows_with_cold):
    pd.testing.assert_frame_equal(tables.headline(rows_with_cold), rows)
    cold = rows_with_cold[rows_with_cold["phase"] != "steady"]
    pd.testing.assert_frame_equal(tables.headline(cold), cold)


def test_flicker_is_shown_where_there_is_any(rows):
    flicker = rows[rows["metric"] == "psnr"].assign(metric="flicker", value=0.01234)
    shown = tables.run_tables(pd.concat([rows, flicker]))[0]
    assert cells(shown)["flicker ↓"][0] == "0.0123"


@pytest.mark.parametrize(("figures", "rule"), [(True, "| --- | ---: |"), (False, "| --- | --- |")])
def test_markdown_sets_figures_to_the_right_and_text_to_the_left(figures, rule):
    table = tables.Table("A title", ("name", "what"), (("a", "1"), ("b", "2")), figures)
    assert table.markdown().splitlines() == ["| name | what |", rule, "| a | 1 |", "| b | 2 |"]


def test_markdown_sets_what_stands_out_in_bold_and_keeps_bars_in_their_cells():
    table = tables.Table("", ("name", "what"), (("a|b", "1"), ("c", "2")), bold=frozenset({(1, 1)}))
    assert table.markdown().splitlines()[2:] == ["| a\\|b | 1 |", "| c | **2** |"]


@pytest.mark.parametrize(
    ("value", "text"), [(1234.567, "1,234.57"), (math.inf, "inf"), (math.nan, "n/a"), (None, "n/a")]
)
def test_a_figure_that_could_not_be_had_is_never_a_number(value, text):
    assert tables.decimal(value, 2) == text


def test_what_rounds_to_zero_has_no_sign():
    assert tables.decimal(-0.0004, 3) == "0.000"
    assert tables.decimal(-0.0006, 3) == "-0.001"
