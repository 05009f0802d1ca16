"""Rows become tables whose every figure has its unit, its share or its `n/a`."""

import math

import pandas as pd
import pytest

from reports import tables


def cells(table: tables.Table) -> dict[str, tuple[str, ...]]:
    return {line[0]: line[1:] for line in table.lines}


def test_a_run_has_its_quality_time_and_memory(rows):
    flicker = rows[rows["metric"] == "psnr"].assign(metric="flicker", value=0.01234)
    rows.loc[rows["metric"] == "stage_ms.other", "value"] = 10.0  # less than is left of the frame
    quality, time, memory = tables.run_tables(pd.concat([rows, flicker]))
    assert quality.title == "Quality, mean of 7 frames"
    assert cells(quality) == {
        "PSNR, dB ↑": ("30.46", "29.50 – 31.50"),
        "SSIM ↑": ("0.9877", "0.9800 – 0.9900"),
        "LPIPS alex ↓": ("n/a", ""),
        "flicker ↓": ("0.0123", "29.5000 – 31.5000"),
    }
    assert cells(time) == {
        "field": ("150.00", "75.0 %"),
        "other": ("10.00", "5.0 %"),
        "frame": ("200.00", "80.0 %"),
        "frame, p50": ("199.00", ""),
        "frame, p95": ("220.00", ""),
        "frame, p99": ("230.00", ""),
        "FPS": ("5.00", ""),
    }
    assert cells(memory) == {
        "table": ("25.00",),
        "model": ("25.20",),
        "peak, rendering": ("1,000.00",),
    }
    untold = tables.run_tables(rows[~rows["metric"].str.startswith("stage_ms.")])
    assert cells(untold[1])["frame"] == ("200.00", "")
    first, *_ = tables.run_tables(rows.assign(n=0))
    assert first.title == "Time of a frame"


def test_work_stands_beside_what_skipping_nothing_takes(rows):
    counted = {"samples": 57_461.4, "rays": 10_000.0, "rays.dense": 40_000.0, "frames": 1.5}
    more = [rows[:1].assign(metric=f"work.{name}", value=of) for name, of in counted.items()]
    _, _, work, _ = tables.run_tables(pd.concat([rows, *more]))
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
    cold = rows_with_cold[rows_with_cold["phase"] != "steady"]
    assert tables.run_tables(cold) == [cold_quality, cold_time, memory]


def test_markdown_aligns_figures_and_keeps_bars_in_their_cells():
    lines = (
        ("1 a|b", "1.5", "fp32", "n/a"),
        ("2", "the same", "2 x", "**+1**"),
        ("3", "", "is", "b"),
    )
    text = tables.Table("A title", ("of", "dB", "what", "more"), lines)
    assert text.markdown().splitlines() == [
        "| of | dB | what | more |",
        "|---|---:|---|---:|",
        "| 1 a\\|b | 1.5 | fp32 | n/a |",
        "| 2 | the same | 2 x | **+1** |",
        "| 3 |  | is | b |",
    ]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1234.5673, "1,234.567"),
        (math.inf, "inf"),
        (math.nan, "n/a"),
        (None, "n/a"),
        (-0.0004, "0.000"),  # without a sign
        (-0.0006, "-0.001"),
    ],
)
def test_a_figure_has_its_decimals_or_is_not_available(value, text):
    assert tables.decimal(value, 3) == text
