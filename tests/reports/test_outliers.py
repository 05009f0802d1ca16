"""Broken rows are found, each by the rule that is meant for it, and sound ones are left alone."""

from collections.abc import Callable
from dataclasses import replace

import pandas as pd
import pytest

from reports.outliers import (
    Outlier,
    far_from_other_scenes,
    far_from_reference,
    faster_with_more_pixels,
    int8_far_from_fp32,
    outlier_table,
    outliers,
    stages_do_not_add_up,
)
from reports.runs import Run
from tests.reports.conftest import changed, elsewhere, run_of

Make = Callable[..., Run]


@pytest.fixture
def make(rows: pd.DataFrame) -> Make:
    """Makes a run of a scene, a seed, a size, a precision; figures by metric."""

    def make_run(
        key: str,
        *,
        scene: str = "totem",
        seed: int = 0,
        width: int = 100,
        precision: str = "fp32",
        **figures: float,
    ) -> Run:
        facts = {"scene": scene, "seed": seed, "resolution": f"{width}x{width}"}
        own = rows.assign(device="cpu", budget="small", precision=precision, **facts)
        engine = {"name": "openvino" if precision == "int8" else "torch"}
        config = {
            "method": {"name": "ngp", "seed": seed, "engine": engine},
            "scene": {"name": scene, "width": width},
            "seed": seed,
            "precision": precision,
            "engine": engine,
        }
        record = {
            "machine": {"cpu": "EPYC", "threads": 2, "gpus": []},
            "made_of": {"config": config},
            "protocol": {"stages": True},
        }
        return changed(run_of(own, key, **record), figures)

    return make_run


def keys(found) -> list[str]:
    return [outlier.key for outlier in found]


def test_a_scene_far_below_a_methods_other_scenes_is_an_outlier(make):
    sound = [make(name, scene=name, psnr=db) for name, db in (("a", 33), ("b", 35), ("c", 26))]
    assert keys(far_from_other_scenes(sound)) == []
    broken = make("mic", scene="mic", psnr=13.0)
    assert keys(far_from_other_scenes([*sound, broken])) == ["mic"]
    assert keys(far_from_other_scenes([sound[0], broken])) == []  # which of two is broken?


def test_many_seeds_of_a_broken_scene_do_not_make_it_the_usual_one(make):
    sound = [make(name, scene=name, psnr=33.0) for name in "abc"]
    broken = [make(f"mic {seed}", scene="mic", seed=seed, psnr=13.0) for seed in range(9)]
    assert keys(far_from_other_scenes([*sound, *broken])) == [run.key for run in broken]


def test_a_known_scene_is_compared_with_its_published_psnr(make):
    runs = [
        make("good", scene="mic", width=800, psnr=33.9),
        make("bad", scene="mic", width=800, psnr=13.0),
        make("smaller", scene="mic", psnr=13.0),
        make("other", width=800),
    ]
    assert list(far_from_reference(runs)) == [
        Outlier("bad", "PSNR 22.6 dB below the published 35.59 dB of Instant-NGP")
    ]


@pytest.mark.parametrize(("field", "found"), [(194, []), (192, ["a"]), (150, ["a"]), (250, ["a"])])
def test_stages_that_leave_a_frame_unexplained_are_outliers(make, field, found):
    """Of 200 ms, the rest lies in no other stage."""
    run = make("a", **{"stage_ms.field": field})
    assert keys(stages_do_not_add_up([run])) == found
    untimed = replace(run, record={"protocol": {"stages": False}})
    untold = replace(run, rows=run.rows[run.rows["metric"] != "stage_ms.field"])  # by a worker
    assert keys(stages_do_not_add_up([untimed, untold])) == []


@pytest.mark.parametrize(("psnr", "found"), [(29.9, []), (28.0, ["int8"])])
def test_int8_is_compared_with_the_same_in_fp32(make, psnr, found):
    runs = [make("fp32", psnr=30.0), make("int8", precision="int8", psnr=psnr)]
    assert keys(int8_far_from_fp32(runs)) == found
    uncalibrated = make("int8", precision="int8 uncalibrated+fp32", psnr=psnr)
    assert keys(int8_far_from_fp32([runs[0], uncalibrated])) == []
    apart = [make("fp32", seed=1, psnr=30.0), runs[1]]
    assert keys(int8_far_from_fp32(apart)) == []


def test_more_pixels_in_less_time_are_outliers_on_one_machine(make):
    small, large = make("small", frame_ms=50.0), make("large", width=200, frame_ms=40.0)
    assert keys(faster_with_more_pixels([large, small])) == ["large"]
    assert keys(faster_with_more_pixels([small, changed(large, {"frame_ms": 60.0})])) == []
    a_little = make("a little", width=150, frame_ms=40.0)
    mixed = changed(large, {}, resolution="mixed")  # frames of several sizes
    for other in (elsewhere(large), a_little, mixed):
        assert keys(faster_with_more_pixels([small, other])) == []


def test_all_rules_are_applied_and_their_reasons_shown(make):
    runs = [make("here", psnr=13.0, scene="mic", width=800)]
    found = outliers(runs)
    assert {outlier.key for outlier in found} == {"here"}
    assert len(found) == 2  # the reference, the stages
    shown = outlier_table(found, runs)
    assert shown.lines[0][:3] == ("here", "ngp", "mic")
    assert outlier_table(found, []).lines == ()
