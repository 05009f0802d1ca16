"""The settings that `steerbench accuracy` compares: they exist, and need one training."""

from __future__ import annotations

from typing import Any

from omegaconf import OmegaConf

from methods.steernerf.method import NOT_TRAINED_FOR
from sweeps.knobs import AS_IT_IS, EVERYTHING_OFF, knobs
from sweeps.overrides import composed
from sweeps.variants import Variant


def variants(trained: bool) -> list[Variant]:
    return [variant for some in knobs(trained).values() for variant in some]


def method(variant: Variant) -> dict[str, Any]:
    """Its settings, as they are trained for, where the method may be rendered otherwise."""
    config = composed(["method=steernerf", *variant.settings])
    node: Any = OmegaConf.to_container(config.method, resolve=True)
    pipeline = {k: v for k, v in node["pipeline"].items() if k not in NOT_TRAINED_FOR}
    if node["_target_"].endswith("UntaughtSteerNerf"):
        pipeline |= {"steps": pipeline.pop("taught_steps"), "stop": pipeline.pop("taught_stop")}
    trained_for = {k: v for k, v in pipeline.items() if k != "_target_"}
    return {k: v for k, v in node.items() if k not in ("_target_", "engine")} | {
        "pipeline": trained_for
    }


def test_there_are_forty_settings_and_no_two_have_one_name():
    assert len(variants(trained=False)) >= 40
    names = [variant.name for variant in variants(trained=True)]
    assert len(set(names)) == len(names)
    assert variants(trained=False)[:2] == [EVERYTHING_OFF, AS_IT_IS]


def test_by_default_one_training_serves_all_settings():
    as_it_is = method(AS_IT_IS)
    for variant in variants(trained=False):
        assert method(variant) == as_it_is, variant.name


def test_what_is_added_asks_for_trainings_of_its_own():
    trainings = [method(AS_IT_IS)]
    for variant in variants(trained=True)[len(variants(trained=False)) :]:
        trainings.append(method(variant))
        assert trainings.count(trainings[-1]) == 1, variant.name
