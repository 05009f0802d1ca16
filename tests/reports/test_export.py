"""The tables of the paper as LaTeX and as CSV."""

import io
import json
from dataclasses import replace

import pandas as pd
import pytest

from reports import export
from reports.paper_tables import Line, PaperTable, Place
from reports.runs import Repeated
from tests.reports.conftest import changed, measured_of

LINES = {
    "t19": Line("T = 2^19", {"method": "a"}, {"First": {"psnr": 33.0}}),
    "k3": Line("K = 3", {"method": "b"}),
    "mine": Line("mine_1", {"method": "c"}),
    "none": Line("not yet", {"method": "d"}, {"First": {"psnr": 30.0}}),
}
TABLE = PaperTable(
    name="table9",
    title="Quality & size",
    metrics=["psnr", "ssim", "size_bytes.total"],
    lines=LINES,
    data_sets=["First"],
    number=9,
)


@pytest.fixture
def measured(run) -> dict[Place, Repeated]:
    """Three measured lines; two of them differ by less than the decimals show."""
    figures = {
        "t19": {"psnr": 30.456, "ssim": 0.9512, "size_bytes.total": 25.24e6},
        "k3": {"psnr": 30.461, "ssim": 0.9514, "size_bytes.total": 25.0e6},
        "mine": {"psnr": 29.0, "ssim": 0.9, "size_bytes.total": 3e6},
    }
    return measured_of(TABLE, {key: changed(run, of) for key, of in figures.items()})


def cells(text: str) -> dict[str, list[str]]:
    rows = [line.removesuffix(r" \\") for line in text.splitlines() if " & " in line]
    return {
        label.strip(): list(map(str.strip, row)) for label, *row in (r.split("&") for r in rows)
    }


def test_latex_is_of_booktabs_has_the_decimals_of_the_paper_and_marks_the_best(measured):
    text = export.exported_tables([TABLE], measured, "latex")
    assert r"\caption{Quality \& size." in text
    for rule in ("toprule", "midrule", "bottomrule"):
        assert text.count(f"\\{rule}") == 1
    assert r"PSNR, dB $\uparrow$" in text
    assert text.isascii()
    found = cells(text)
    # 0.9512 and 0.9514 are both .951: they share the first place.
    assert found["T = 2$^{19}$"] == [r"\textbf{30.46}", r"\textbf{0.951}", "25.2"]
    assert found["K = 3"] == [r"\textbf{30.46}", r"\textbf{0.951}", r"\underline{25.0}"]
    assert found["not yet"] == ["--", "--", "--"]  # not measured
    assert found[r"mine\_1"] == ["29.00", "0.900", r"\textbf{3.0}"]
    # Of several seeds, half of the interval: t(0.975, 1) = 12.71.
    place = Place("table9", "First", "k3")
    runs = [changed(measured[place].runs[0], {"psnr": psnr}) for psnr in (29.0, 31.0)]
    found = cells(export.exported_tables([TABLE], {place: Repeated("K = 3", runs)}, "latex"))
    assert found["K = 3"][0] == r"30.00 $\pm$ 12.71"


def test_a_metric_that_the_paper_lacks_is_written_as_on_our_pages(measured):
    table = replace(TABLE, metrics=["flicker", "peak_bytes"])
    (run,) = measured[Place("table9", "First", "t19")].runs
    rows = run.rows.replace({"metric": {"ssim": "flicker"}})
    shown = changed(replace(run, rows=rows), {"flicker": 0.1234, "peak_bytes": 2.5e9})
    found = cells(export.exported_tables([table], measured_of(table, {"t19": shown}), "latex"))
    assert found["T = 2$^{19}$"] == ["0.1234", "2,500.00"]


def test_a_rule_stands_before_what_is_of_a_further_data_set(measured):
    table = replace(TABLE, data_sets=["First", "Second"], beside=["k3"])
    of_first = measured[Place("table9", "First", "k3")]
    both = {**measured, Place("table9", "Second", "k3"): of_first}
    text = export.exported_tables([table], both, "latex")
    first, second = text.split("\\midrule\n")[1:]
    assert "(Second)" not in first
    assert second.startswith("K = 3 (Second) & ")
    assert "Second" not in export.exported_tables([table], measured, "latex")


def test_csv_has_a_figure_a_row_as_it_was_measured(measured):
    found = pd.read_csv(io.StringIO(export.exported_tables([TABLE], measured, "csv")))
    assert len(found) == len(LINES) * len(TABLE.metrics)
    row = found.set_index(["line", "metric"]).loc[("t19", "psnr")]
    assert row["label"] == "T = 2^19"
    assert (row["measured"], row["published"], row["runs"]) == (30.456, 33.0, 1)
    (first, *_) = json.loads(export.exported_tables([TABLE], measured, "json"))
    assert (first["line"], first["metric"], first["measured"]) == ("t19", "psnr", 30.456)
    markdown = export.exported_tables([TABLE], measured, "markdown")
    assert markdown.startswith("## Quality & size\n\n| measured | PSNR, dB ↑ |")
    assert pd.isna(row["half_interval"])
