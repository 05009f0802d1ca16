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


def variants(name: str) -> tuple[list[Variant], list[Variant]]:
    """All settings of all knobs: those chosen after the training, those that need their own."""
    found = study(name)
    first, second = (
        [variant for some in knobs.values() for variant in some]
        for knobs in (found.knobs, found.trained)
    )
    return first, second


@pytest.mark.parametrize("name", METHODS)
def test_no_two_settings_have_one_name(name):
    names = [variant.name for some in variants(name) for variant in some]
    assert len(set(names)) == len(names)


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_one_training_serves_all_that_is_chosen_afterwards(name):
    found = study(name)
    off = [Variant(words, (f"{setting}=false",)) for words, setting in found.skips.items()]
    exact = Variant("everything off", found.exact)
    for variant in (*variants(name)[0], *found.savings, *off, exact):
        assert trained(name, *variant.settings) == trained(name), variant.name


@pytest.mark.parametrize("name", METHODS)
def test_other_knobs_need_a_training_each(name):
    trainings = [trained(name)]
    for variant in variants(name)[1]:
        trainings.append(trained(name, *variant.settings))
        assert trainings.count(trainings[-1]) == 1, variant.name


@pytest.mark.parametrize("name", METHODS)
def test_what_is_chosen_afterwards_is_a_setting_of_the_method(name):
    assert set(study(name).chosen) <= composed([f"method={name}"]).method.keys()


@pytest.mark.parametrize("name", METHODS)
def test_axes_and_other_methods_can_be_set(name):
    found = study(name)
    for axis in found.axes.values():
        for value in axis.values:
            composed([f"method={name}", f"{axis.setting}={value}"])
        assert axis.size is None or len(axis.size) == len(axis.values)
    for settings in found.beside.values():
        composed(settings)
