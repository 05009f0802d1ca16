"""`steerbench accuracy`: which knobs are varied, what is recommended, what is written."""

from __future__ import annotations

import math

import pytest
from matplotlib.figure import Figure

from bench.errors import SteerbenchError
from bench.study import Study, Variant
from sweeps import variants
from sweeps.commands.accuracy import _last_words, _recommended, decibels

EXACT = "method.rendering.skip.empty=false"

ERROR = {"subject": "ramp", "knob": "step", "setting": 0.25, "error": 0.125, "order": None,
         "order_from": None, "order_to": None, "ms": 1.5, "ms_lo": 1.0, "ms_hi": 2.0}  # fmt: skip
FIGURES = {"everything off": (100.0, 30.0), "as it is": (100.0, 30.0), "fast": (10.0, 29.9),
           "faster": (5.0, 29.0), "poor": (20.0, 20.0)}  # fmt: skip


@pytest.fixture
def measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """`FIGURES`, in place of what the settings take and lose."""
    turned = [Variant(name, (f"method.rendering.refined={ms / 100}",)) for name, (ms, _) in
              list(FIGURES.items())[2:]]  # fmt: skip
    study = Study({"share": turned[:2], "length": turned[2:]}, exact=(EXACT,))
    where = {"scene": "totem", "trajectory": "orbit", "resolution": "8x8"}
    rows = [
        {"setting": name, "ms": ms, "ms_lo": ms, "ms_hi": ms, "psnr": psnr,
         "psnr_to_first": 40.0 if index else math.inf, **where}
        for index, (name, (ms, psnr)) in enumerate(FIGURES.items())
    ]  # fmt: skip
    monkeypatch.setattr(variants, "declared", lambda config: study)
    monkeypatch.setattr(variants, "engines", lambda words: [variants.AS_IT_IS])
    monkeypatch.setattr(
        variants, "render", lambda lines, *_: [row for row in rows if row["setting"] in lines]
    )
    monkeypatch.setattr("sweeps.commands.accuracy.experiment_rows", lambda *arguments: [ERROR])
    monkeypatch.setattr("methods.checks.found", lambda name: [])
    monkeypatch.setattr("reports.tradeoff.frontier_plot", lambda rows, path: Figure().savefig(path))


@pytest.mark.parametrize("text", ["0.1dB", "0.1 dB", ".1", "0.1", "0.10db"])
def test_a_budget_is_read_with_its_unit_or_without(text):
    assert decibels(text) == 0.1


@pytest.mark.parametrize("text", ["", "dB", "-1dB", "1e", "nan", "1 ms"])
def test_what_is_no_budget_is_refused(text):
    with pytest.raises(SteerbenchError, match="expected decibels"):
        decibels(text)


def test_every_row_is_printed_as_json_and_left_with_a_report(steerbench, measured, tmp_path):
    found = steerbench("accuracy", "outputs=here").ok().json
    assert found["kernels"] == [ERROR]
    settings = {row["setting"]: row for row in found["settings"]}
    assert list(settings) == list(FIGURES)
    assert settings["everything off"]["psnr_to_first"] is None
    assert settings["fast"]["lost"] == pytest.approx(0.1)
    assert settings["fast"]["instead"] == "fast"
    assert settings["poor"]["instead"] == "fast"
    names = {path.name for path in (tmp_path / "here" / "accuracy").iterdir()}
    assert names == {"report.md", "report.html", "pictures", "kernels.csv", "settings.csv"}


@pytest.mark.parametrize(
    ("budget", "setting"),
    [
        ("0.2dB", "method.rendering.refined=0.1"),
        ("1dB", "method.rendering.refined=0.05"),
        ("20", "method.rendering.refined=0.05"),
        ("0.01", EXACT),  # nothing faster keeps within it
    ],
)
def test_the_fastest_setting_within_the_budget_is_a_command(steerbench, measured, budget, setting):
    outcome = steerbench("accuracy", "--within", budget, "seed=3")
    usual = "method=steernerf scene=totem budget=demo trajectory=orbit"
    assert outcome.out.splitlines()[-2] == f"steerbench run {usual} seed=3 {setting}"


def test_no_setting_is_recommended_beside_a_perfect_picture():
    rows = [{"setting": "as it is", "ms": 1.0, "lost": math.nan}]  # inf - inf
    assert _recommended(rows, 0.1).endswith("because 'as it is' has an infinite PSNR")


def test_a_later_word_replaces_one_of_the_same_setting_and_no_folder():
    words = ["--config-dir=a", "seed=1", "--config-dir=b", "seed=2"]
    assert _last_words(words) == ["--config-dir=a", "seed=2", "--config-dir=b"]


def test_the_kernels_alone_train_and_render_nothing(steerbench, measured, monkeypatch):
    monkeypatch.setattr(variants, "render", None)
    assert steerbench("accuracy", "--kernels").json == {"kernels": [ERROR], "settings": []}
