"""What our methods declare in their studies: the settings exist, and knobs need no training."""

from __future__ import annotations

from functools import cache
from typing import Any

import pytest
from omegaconf import OmegaConf

from bench.study import Study, Variant
from sweeps.overrides import choices, composed
from sweeps.variants import declared

METHODS = [name for name, path in choices("method").items() if "_target_" in OmegaConf.load(path)]
"""Those with a class of their own: the others declare what the method does that they vary."""


@cache
def study(name: str) -> Study:
    return declared(composed([f"method={name}"]))


@cache
def trained(name: str, *settings: str) -> dict[str, Any]:
    """What the training of a method depends on, by what it says itself."""
    config = composed([f"method={name}", *settings])
    node: Any = OmegaConf.to_container(config.method, resolve=True)
    return {key: value for key, value in node.items() if key not in study(name).chosen}


def variants(name: str, *kinds: str) -> list[Variant]:
    """All settings of all knobs of these kinds."""
    knobs = [each for kind in kinds for each in getattr(study(name), kind).values()]
    return [variant for some in knobs for variant in some]


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_one_training_serves_all_that_is_chosen_afterwards(name):
    found = study(name)
    off = [Variant(words, (f"{setting}=false",)) for words, setting in found.skips.items()]
    exact = Variant("everything off", found.exact)
    for variant in (*variants(name, "knobs"), *found.savings, *off, exact):
        assert trained(name, *variant.settings) == trained(name), variant.name


@pytest.mark.parametrize("name", METHODS)
def test_other_knobs_need_a_training_each(name):
    trainings = [trained(name)]
    for variant in variants(name, "trained"):
        trainings.append(trained(name, *variant.settings))
        assert trainings.count(trainings[-1]) == 1, variant.name


@pytest.mark.parametrize("name", METHODS)
def test_what_is_declared_can_be_set_and_has_names_of_its_own(name):
    found = study(name)
    names = [variant.name for variant in variants(name, "knobs", "trained")]
    assert len(set(names)) == len(names)
    assert set(found.chosen) <= composed([f"method={name}"]).method.keys()
    for axis in found.axes.values():
        for value in axis.values:
            composed([f"method={name}", f"{axis.setting}={value}"])
        assert axis.size is None or len(axis.size) == len(axis.values)
    for settings in found.beside.values():
        composed(settings)
