"""The studies of a method that declares what can be varied, and of one that declares nothing."""

from __future__ import annotations

import math

import pytest
import torch
from sweeps.commands.scaling import growth
from sweeps.variants import fitted

from bench.errors import SteerbenchError, Unavailable
from bench.study import Study
from sweeps.overrides import engine_kinds
from tests.sweeps.conftest import STAND_INS, Outcome

FRAMES = ["--frames", "2", "--repeats", "1"]
TORCH = [f"torch, {precision}" for precision in engine_kinds(())["torch"].precisions]


@pytest.fixture
def study(steerbench, monkeypatch):
    """Call a study of a stand-in, without experiments on kernels."""
    monkeypatch.setattr("methods.checks.found", lambda name: [])

    def call(command: str, method: str, *argv: str) -> Outcome:
        rounds = FRAMES if command != "scaling" else FRAMES[:2]
        common = ["trajectory=test", "engine=torch", f"method={method}", *argv]
        return steerbench(command, *STAND_INS, *rounds, *common)

    return call


def test_accuracy_varies_every_knob_and_the_engine(study):
    found = study("accuracy", "shades").ok().json["settings"]
    names = [row["setting"] for row in found]
    assert names[:5] == ["everything off", "as it is", "level 0.4", "level 0.6", "level 1.0"]
    assert {"torch, bf16", "openvino, fp32"} <= set(names)
    assert "torch, fp32" not in names  # the default
    row = found[4]
    assert (row["knob"], row["overrides"].split()[-1]) == ("level", "method.level=1.0")
    assert row["lost"] is None  # white on white: nothing is wrong with it
    assert found[0]["work.halves"] == 1  # `exact` switches one skip off


def test_accuracy_adds_what_needs_a_training_when_asked(study):
    filters = ["--filter", "trained", "--filter", "level"]
    found = study("accuracy", "shades", "--trained", *filters).ok().json["settings"]
    names = [row["setting"] for row in found if row["knob"] != "level"]
    assert names == ["everything off", "as it is", "seed 7"]


def test_accuracy_renders_a_method_without_knobs_as_it_is_and_says_so(study):
    outcome = study("accuracy", "grey", "--within", "1dB")
    (row,) = outcome.ok().json["settings"]
    assert (row["setting"], row["lost"]) == ("as it is", 0)
    assert "stand_ins.Grey declares no knobs in `study`" in outcome.err
    assert "within 1 dB of as it is: as it is" in outcome.out


def test_skips_shows_the_work_without_each_skip(study):
    outcome = study("skips", "shades")
    found = {row["skipped"]: row for row in outcome.ok().json}
    halves = {"all": 0, "all, and half as bright": 0}
    halves |= {"all but left half": 1, "all but right half": 1, "nothing": 2}
    assert {name: row["halves"] for name, row in found.items()} == halves
    assert found["all, and half as bright"]["lost"] > 0
    assert "1 (50.0 %)" in outcome.out


def test_breakdown_divides_the_frame_and_names_every_line(study):
    found = {row["line"]: row for row in study("breakdown", "shades", "method.level=0.3").ok().json}
    ends = ("", ", nothing skipped", ", a twin")
    assert list(found) == [*(line + end for end in ends for line in TORCH), "plain grey"]
    for row in found.values():
        assert sum(row["parts"].values()) == pytest.approx(row["frame_ms"])
    assert set(found["torch, fp32"]["parts"]) == {"painting", "varnish", "other"}
    assert set(found["plain grey"]["parts"]) == {"paint", "other"}
    assert len({row["psnr"] for row in found.values()}) == 1  # all have the level that was typed


def test_breakdown_of_a_method_without_engine_and_study_is_one_line(study):
    (row,) = study("breakdown", "grey").ok().json
    assert row["line"] == "as it is"
    assert set(row["parts"]) == {"paint", "other"}


def test_breakdown_says_which_lines_of_a_frame_wait_for_the_gpu(study, gpu, monkeypatch):
    def asking(self, camera, probe):
        torch.ones(1, device="cuda").item()
        return render(self, camera, probe)

    import stand_ins

    render = stand_ins.Grey.render
    monkeypatch.setattr("stand_ins.Grey.render", asking)
    (row,) = study("breakdown", "grey", "--device-waits").ok().json
    assert row["waits"] == 1
    assert row["line"].startswith("tests/sweeps/commands/test_studies.py:")
    assert row["source"] == 'torch.ones(1, device="cuda").item()'


def test_a_line_of_another_budget_has_no_quality(study, monkeypatch):
    short = Study(beside={"short": ("method=grey", "budget.steps=2")})
    monkeypatch.setattr("stand_ins.Shades.study", short)
    found = {row["line"]: row for row in study("breakdown", "shades").ok().json}
    assert found["short"]["psnr"] is None
    assert found["torch, fp32"]["psnr"] is not None


def test_parity_compares_every_engine_with_torch_in_fp32(study):
    found = {row["engine"]: row for row in study("parity", "shades").ok().json}
    assert next(iter(found)) == "torch, fp32"
    assert "openvino, int8" in found
    for row in found.values():
        assert (row["lost"], row["apart"], row["bytes"]) == (0, None, 4)
        assert 0 < row["network_ms"] < row["frame_ms"]


NO_GPU = pytest.mark.skipif(torch.cuda.is_available(), reason="for a machine without a GPU")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (("skips", "grey"), "stand_ins.Grey declares nothing in `study.skips`"),
        (("parity", "grey"), "expected a method with the setting method.engine"),
        pytest.param(("breakdown", "grey", "--device-waits"), "a GPU is needed", marks=NO_GPU),
        (("scaling", "shades", "engine=openvino"), "--axis threads: expected engine=torch"),
        (("scaling", "shades", "--axis=width"), "unknown axis 'width'"),
        (("accuracy", "shades", "--filter=colour"), "no knob has 'colour' in its name; expected p"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, tuple) else "",
)
def test_what_cannot_be_studied_is_refused(study, argv, message):
    outcome = study(*argv)
    assert message in outcome.refused()
    assert not outcome.out


def test_a_study_is_computed_where_hydras_launcher_puts_it(study, launched):
    study("parity", "shades").ok()
    assert launched == [1]  # in turns: one job
    assert "queue" in study("parity", "shades", "+hydra.launcher.queue=gpu").refused()


def test_scaling_fits_the_axes_of_the_method(study):
    outcome = study("scaling", "shades", "method.skip.left=false", "--axis", "N")
    found = outcome.ok().json
    assert [(row["label"], row["value"], row["work.halves"]) for row in found] == [
        ("N = 2^0", 1.0, 1),
        ("N = 2^3", 8.0, 8),
    ]
    (line,) = [line for line in outcome.out.splitlines() if "exponent of N" in line]
    assert "1.00" in line  # of the halves


def test_scaling_has_pixels_and_threads_for_every_method(study):
    found = study("scaling", "grey").ok().json
    assert {row["axis"] for row in found} == {"pixels", "threads"}


def test_a_value_of_0_is_left_out_and_a_single_one_has_no_exponent():
    rows = [{"value": value, "ms": 5.0 + value} for value in (0.0, 1.0, 7.0)]
    assert growth(rows, "ms") == pytest.approx(math.log(2) / math.log(7))
    assert math.isnan(growth([{"value": 2.0, "ms": 1.0}, {"value": 2.0, "ms": 2.0}], "ms"))


def test_a_stage_is_counted_with_the_innermost_that_is_declared():
    study = Study(parts={"renderer": "renderer", "renderer/network": "network"})
    parts = map(study.part_of, ("renderer/other", "renderer/network/layer", "some stage/inside"))
    assert list(parts) == ["renderer", "network", "some stage/inside"]


# Variants on common ground

ABSENT = 0.9
"""The level of a grey that cannot be used."""


@pytest.fixture
def trained(elsewhere: None, monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The levels of the greys that were fitted."""
    import stand_ins

    levels: list[float] = []
    make = stand_ins.Grey.__init__

    def made(self, seed: int, device: str, backend: str, level: float) -> None:
        if level == ABSENT:
            raise Unavailable("it is not installed")
        make(self, seed, device, backend, level)

    monkeypatch.setattr(stand_ins.Grey, "__init__", made)
    monkeypatch.setattr(stand_ins.Grey, "fit", lambda self, *_: levels.append(self.level))
    return levels


def greys(*levels: float, more: tuple[str, ...] = ()) -> dict[str, list[str]]:
    return {str(level): [*STAND_INS, f"method.level={level}", *more] for level in levels}


def test_what_cannot_be_used_is_left_out_unless_it_is_the_first(trained):
    with fitted(greys(0.1, ABSENT, 0.3), 2) as (methods, _, _):
        assert list(methods) == ["0.1", "0.3"]
    assert trained == [0.1, 0.3]
    with pytest.raises(Unavailable), fitted(greys(ABSENT, 0.3), 2):
        pass


@pytest.mark.parametrize(
    ("memory", "more", "message"),
    [
        (2, (), "give more frames"),
        (0, ("+protocol.memory=cold", "protocol.name=cold"), r"protocol\.memory: expected steady"),
    ],
)
def test_what_cannot_be_compared_is_refused_at_once(trained, monkeypatch, memory, more, message):
    monkeypatch.setattr("stand_ins.Grey.memory", memory)
    with pytest.raises(SteerbenchError, match=message), fitted(greys(0.1, more=more), 2):
        pass
    assert trained == []


def test_pictures_too_small_for_lpips_are_not_refused_where_it_is_not_computed(trained):
    with fitted(greys(0.1, more=("protocol=steerbench-1",)), 1) as (_, ground, _):
        assert len(ground.trajectory.steps) == 1
        assert ground.protocol.lpips == ()
