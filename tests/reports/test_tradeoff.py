"""Tables, plot and page of run time against error."""

from __future__ import annotations

import math

from reports.figures import frontier_plot
from reports.tradeoff import experiment_table, setting_table, write_tradeoff

STEP = {"subject": "ramp: depth", "knob": "step", "order": 1.996,
        "order_from": 1 / 64, "order_to": 0.25, "ms_lo": 1.0, "ms_hi": 2.0}  # fmt: skip
EXPERIMENTS = [
    STEP | {"setting": 0.25, "error": 0.00384, "ms": 0.39},
    STEP | {"setting": 1 / 64, "error": 1.5e-5, "ms": 0.6},
    {"subject": "encoding", "knob": "table", "setting": "packed bf16", "error": 3.7e-3, "ms": 6.0,
     "ms_lo": 5.0, "ms_hi": 7.0, "order": None, "order_from": None,
     "order_to": None},
]  # fmt: skip


def setting(name: str, ms: float, psnr: float, instead: str) -> dict:
    return {"scene": "totem", "trajectory": "test-orbit", "resolution": "400x400",
            "knob": name.split()[0], "setting": name, "ms": ms, "ms_lo": 0.9 * ms,
            "ms_hi": 1.2 * ms, "psnr": psnr, "lost": 31 - psnr, "instead": instead,
            "psnr_to_first": math.inf if name == "everything off" else psnr + 8,
            "overrides": ""}  # fmt: skip


SETTINGS = [
    setting("everything off", 400.0, 31.0, "everything off"),
    setting("as it is", 50.0, 30.0, "refined 0"),
    setting("refined 0", 40.0, 30.25, "refined 0"),
]


def test_an_experiment_is_named_once_with_its_order_and_where_that_was_fitted():
    lines = experiment_table(EXPERIMENTS).lines
    assert lines[0] == (
        *("ramp: depth", "step", "1/4 to 1/64", "3.8e-03 to 1.5e-05", "0.39 to 0.60"),
        "2.00 (1/64 to 1/4)",
    )
    assert lines[1] == ("encoding", "table", "packed bf16", "3.7e-03", "6.00", "")


def test_settings_are_sorted_by_time_and_the_frontier_is_bold():
    table = setting_table(SETTINGS)
    assert [line[0] for line in table.lines] == ["refined 0", "as it is", "everything off"]
    assert table.bold == {(0, 0), (2, 0)}
    assert table.lines[1] == (
        "as it is", "50.0", "45.0 – 60.0", "30.00", "1.00", "38.0", "refined 0"
    )  # fmt: skip
    assert table.lines[2][5] == "the same"


def test_the_page_shows_both_tables_and_the_plot(tmp_path):
    page = write_tradeoff(
        EXPERIMENTS, SETTINGS, tmp_path / "accuracy", "steerbench accuracy seed=3"
    )
    text = page.read_text()
    assert "](pictures/frontier-" in text
    assert "steerbench accuracy seed=3" in text
    assert setting_table(SETTINGS).markdown() in text
    assert experiment_table(EXPERIMENTS).markdown() in text
    assert not list(page.parent.glob(".*"))


def test_without_settings_the_page_is_that_of_the_kernels(tmp_path):
    page = write_tradeoff(EXPERIMENTS, [], tmp_path, "steerbench accuracy --kernels")
    assert "frontier" not in page.read_text()
    assert {path.name for path in tmp_path.iterdir()} == {"report.md", "report.html", "kernels.csv"}


def test_a_setting_far_slower_than_the_frontier_is_only_named(tmp_path, drawn):
    frontier_plot([*SETTINGS, setting("empty space", 801.0, 20.0, "refined 0")], tmp_path)
    frontier_plot([*SETTINGS, setting("empty space", 799.0, 20.0, "refined 0")], tmp_path)
    assert [figure.get_suptitle() for figure in drawn] == ["not shown: empty space, 801 ms", ""]
