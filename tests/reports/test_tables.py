"""Rows become tables whose every figure has its unit, its share or its `n/a`."""

from __future__ import annotations

import math

import pytest

from reports import tables


def cells(table: tables.Table) -> dict[str, tuple[str, ...]]:
    """The figures of a table by the label of their line."""
    return {line[0]: line[1:] for line in table.lines}


def test_quality_names_the_lpips_network_and_shows_what_is_missing(rows):
    quality, _, _ = tables.blocks(rows)
    assert quality.title == "Quality, mean of 7 frames"
    assert cells(quality) == {
        "PSNR, dB ↑": ("30.46", "29.50 – 31.50"),
        "SSIM ↑": ("0.9877", "0.9800 – 0.9900"),
        "LPIPS alex ↓": ("n/a", ""),
    }


def test_time_shows_every_stage_with_its_share_of_the_frame(rows):
    _, time, _ = tables.blocks(rows)
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
    assert cells(tables.blocks(rows)[1])["frame"] == ("200.00", "80.0 %")


def test_memory_is_in_decimal_megabytes(rows):
    _, _, memory = tables.blocks(rows)
    assert cells(memory) == {
        "table": ("25.00",),
        "model": ("25.20",),
        "peak, rendering": ("1,000.00",),
    }


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
    assert tables.number(value, 2) == text
