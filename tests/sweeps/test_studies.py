"""Studies: their lines are runs of the store, of what methods declare; each shows them its way."""

import functools
import io
from collections.abc import Mapping
from pathlib import Path

import pandas as pd
import pytest
import torch

from bench.errors import Unavailable
from bench.results import Store
from bench.study import Axis, Study, turned
from sweeps import experiments
from sweeps.commands.study import decibels
from sweeps.overrides import engine_kinds
from sweeps.studies import subjects
from tests.common import refusal
from tests.sweeps.conftest import QUICK, STAND_INS

ROUNDS = ["trajectory=test", "engine=torch", "protocol=study-1", "protocol.rounds=2"]
TORCH = [f"torch, {precision}" for precision in engine_kinds(())["torch"].precisions]


@pytest.fixture
def study(steerbench):
    def call(command, method, *argv):
        return steerbench(command, *STAND_INS, *ROUNDS, f"method={method}", *argv)

    return call


def page(study: str) -> pd.DataFrame:
    """The first table of the page of a study, as text, by the first cell of a line."""
    text = Path(f"outputs/{study}/report.md").read_text()
    table = io.StringIO(text[text.index("|") :].partition("\n\n")[0].replace("**", ""))
    cells = pd.read_csv(table, sep=r"\s*\|\s*", engine="python", dtype=str, keep_default_na=False)
    return cells.iloc[1:, 1:-1].set_index(cells.columns[1])


def stored(metric: str) -> Mapping[str, float]:
    """A metric of all runs of the store, by their key."""
    rows = Store(Path("outputs")).rows()
    return dict(rows[rows["metric"] == metric].set_index("run")["value"])


def test_accuracy_varies_every_knob_and_the_engine_beside_what_all_are_compared_with(study):
    study("accuracy", "shades").ok()
    shown = page("accuracy")
    levels = ["level 0.4", "level 0.6", "level 1.0"]
    assert {"everything off", "as it is", *levels, *TORCH[1:], "openvino, int8"} <= set(shown.index)
    assert shown.index.is_unique
    assert shown.loc["level 1.0", "PSNR, dB ↑"] == "inf"  # white on white
    assert shown.loc["as it is", "PSNR to the first, dB ↑"] == "the same"
    assert len(stored("psnr")) == len(shown) + 2  # each of two knobs is measured beside both
    assert set(stored("psnr_to_first")) == set(stored("psnr"))


def test_accuracy_adds_what_needs_a_training_when_asked(study):
    study("accuracy", "shades", "--trained", "--only", "trained").ok()
    assert set(page("accuracy").index) == {
        "everything off",
        "as it is",
        "N = 2^0",
        "N = 2^3",
        "seed 7",
    }


def test_accuracy_recommends_the_fastest_setting_within_a_loss_as_a_command(study):
    outcome = study("accuracy", "grey", "--within", "1dB").ok()
    assert "grey, within 1 dB of as it is: as it is" in outcome.out
    command = outcome.out.splitlines()[-1]
    assert command.startswith("steerbench run --config-dir=")
    assert command.endswith(f" +experiment=accuracy {' '.join([*QUICK[1:], *ROUNDS])} method=grey")


def test_nothing_is_recommended_beside_a_perfect_picture(study):
    outcome = study("accuracy", "grey", "method.level=1.0", "--within", "1dB").ok()
    assert "grey: no setting, because 'as it is' has an infinite PSNR" in outcome.out


@pytest.mark.parametrize("text", ["0.1dB", "0.1 dB", ".1", "0.1", "0.10db"])
def test_a_loss_is_read_with_its_unit_or_without(text):
    assert decibels(text) == 0.1


@pytest.mark.parametrize("text", ["", "dB", "-1dB", "1e", "nan", "1 ms"])
def test_what_is_no_loss_is_refused(text):
    with refusal("expected decibels"):
        decibels(text)


def test_a_study_that_was_killed_measures_the_other_half(study, monkeypatch):
    import sweeps.measurement as measurement

    measure, measured = measurement.measure, []

    def killed_at(limit):
        def call(methods, task, log, guard):
            if len(measured) == limit:
                raise KeyboardInterrupt
            measured.append(len(methods))
            return measure(methods, task, log, guard)

        return call

    knobs = {"dark": turned("level", "method.level", (0.1, 0.2))}
    knobs["light"] = turned("level", "method.level", (0.8, 0.9))
    monkeypatch.setattr("stand_ins.Grey.study", Study(knobs), raising=False)
    monkeypatch.setattr(measurement, "measure", killed_at(1))
    assert study("accuracy", "grey").status == 130
    half = stored("frame_ms")
    assert len(half) == 3  # as it is, and two of the first knob
    monkeypatch.setattr(measurement, "measure", killed_at(2))
    study("accuracy", "grey").ok()
    assert measured == [3, 3]
    whole = stored("frame_ms")
    assert {key: whole[key] for key in half} == half
    study("accuracy", "grey").ok()  # all of it is there


def test_what_cannot_be_used_is_left_out_unless_all_are_compared_with_it(study, monkeypatch):
    import stand_ins

    make = stand_ins.Shades.__init__

    @functools.wraps(make)
    def made(self, **settings):
        if settings["level"] == absent:
            raise Unavailable("it is not installed")
        make(self, **settings)

    monkeypatch.setattr("stand_ins.Shades.__init__", made)
    absent = 0.6
    study("accuracy", "shades", "--only", "level").ok()
    assert {"as it is", "level 0.4", "level 1.0"} < set(page("accuracy").index)
    assert "level 0.6" not in page("accuracy").index
    absent = 0.5
    outcome = study("accuracy", "shades", "--only", "level", "seed=1")
    assert (outcome.status, stored("psnr").keys() & ()) == (1, set())
    assert outcome.err.count("it is not installed") == 5


def test_skips_shows_the_work_without_each_skip(study):
    study("skips", "shades").ok()
    shown = page("skips")
    halves = {"all": "0 (0.0 %)", "all, and half as bright": "0 (0.0 %)", "nothing": "2 (100.0 %)"}
    halves |= dict.fromkeys(("all but left half", "all but right half"), "1 (50.0 %)")
    assert dict(shown["halves"]) == halves
    assert float(shown.loc["all, and half as bright", "lost, dB ↓"]) > 0


def test_breakdown_divides_the_frame_of_all_methods_and_names_every_line(study):
    study("breakdown", "shades,grey", "method.level=0.3").ok()
    shown = page("breakdown")
    ends = ("", ", nothing skipped")
    assert list(shown.index) == [*(f"shades, {x}{end}" for end in ends for x in TORCH), "grey"]
    assert list(shown.columns[:5]) == ["painting", "network", "varnish", "paint", "other"]
    assert len(set(shown["PSNR, dB ↑"])) == 1  # all have the level that was typed
    for run, ms in stored("frame_ms").items():
        rows = Store(Path("outputs")).rows(keys=[run])
        stages = rows[rows["metric"].str.startswith("stage_ms.")]
        assert stages["value"].sum() == pytest.approx(ms)


def test_breakdown_says_which_lines_of_a_frame_wait_for_the_gpu(study, gpu, monkeypatch):
    def asking(self, camera, probe):
        torch.ones(1, device="cuda").item()
        return render(self, camera, probe)

    import stand_ins

    render = stand_ins.Grey.render
    monkeypatch.setattr("stand_ins.Grey.render", asking)
    outcome = study("breakdown", "grey", "protocol.waits=true").ok()
    assert "grey: 1.0 waits for the GPU a frame" in outcome.out
    assert 'torch.ones(1, device="cuda").item()' in outcome.out


def test_parity_compares_every_engine_with_torch_in_fp32(study):
    study("parity", "shades").ok()
    shown = page("parity")
    assert shown.index[0] == TORCH[0]
    assert "openvino, int8" in shown.index
    assert set(shown["PSNR to the first, dB ↑"]) == {"the same"}
    assert set(shown["lost, dB ↓"]) == {"0.000"}
    assert "n/a" not in set(shown["network, ms ↓"])


NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="for a machine without a GPU")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("skips", "grey"), "stand_ins.Grey declares nothing in `study.skips`"),
        (("parity", "grey"), "expected a method with the setting method.engine"),
        (("scaling", "shades", "engine=openvino"), "threads: expected engine=torch"),
        (("scaling", "shades", "--only=width"), "unknown axis 'width'"),
        (("accuracy", "shades", "--only=colour"), "unknown knob 'colour'"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, tuple) else "",
)
def test_what_cannot_be_studied_is_refused(study, argv, message):
    outcome = study(*argv)
    assert message in outcome.refused()
    assert not outcome.out


@NO_GPU
def test_waits_need_a_gpu(study):
    assert "a GPU is needed" in study("breakdown", "grey", "protocol.waits=true").err


def test_a_study_is_computed_where_hydras_launcher_puts_it(study, launched):
    study("parity", "shades").ok()
    assert launched == [len(engine_kinds(()))]  # in turns: a job for each engine
    assert "queue" in study("parity", "shades", "+hydra.launcher.queue=gpu").refused()


def test_scaling_fits_the_axes_of_the_method(study):
    study("scaling", "shades", "method.skip.left=false", "--only", "N").ok()
    shown = page("scaling")
    assert list(shown.index) == ["N = 2^0", "N = 2^3", "exponent of N"]
    assert list(shown["halves"]) == ["1", "8", "1.00"]


def test_scaling_has_pixels_and_threads_for_every_method_and_scores_nothing_at_other_sizes(study):
    study("scaling", "grey").ok()
    shown = page("scaling")
    assert {"200 x 200", "1 threads", "exponent of pixels", "exponent of threads"} <= set(
        shown.index
    )
    rows = Store(Path("outputs")).rows()
    assert {"200x200", "40x32"} <= set(rows["resolution"])
    sized = rows[(rows["resolution"] == "200x200") & (rows["metric"] == "psnr")]
    assert sized["value"].isna().all()


def test_axes_of_tables_belong_to_their_method():
    axes = experiments.axes("steernerf")
    assert axes["L"] == Axis("L = {}", "method.model.frames", (0, 1, 2, 3))
    assert axes["T"].size(14) == 2**14
    assert axes["K"].size(9) == 9
    assert experiments.axes("ngp") == {}


def test_several_methods_get_what_they_have_of_the_settings(elsewhere):
    found = subjects("accuracy", [*STAND_INS, "method=grey,shades", "method.log2_layers=1"])
    assert [subject.name for subject in found] == ["grey", "shades"]
    assert "log2_layers" not in found[0].config.method
    assert found[1].config.method.log2_layers == 1
