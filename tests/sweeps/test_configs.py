"""Settings are in the configurations, each once, and sizes and studies change what is there."""

import inspect
from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from bench.study import Study, Variant
from sweeps.overrides import CONFIGS, choices, composed, leaves
from sweeps.studies import Subject

GROUPS = ("method", "scene", "trajectory", "protocol", "budget")
CHOICES = [f"{group}={name}" for group in GROUPS for name in choices(group)]
SIZES = sorted((CONFIGS / "size").glob("*/*.yaml"))
USERS = {
    **{"field": "method=ngp", "unet": "method=steernerf", "tables": "method=ngp"},
    **{"totem": "scene=totem", "totem_hd": "scene=totem_hd", "student": "method=nerf"},
}
"""Of sizes that are not of one method: a word that chooses what takes them in."""


@cache
def node(choice: str, *words: str) -> dict[str, Any]:
    config = composed([choice, *words])[choice.partition("=")[0]]
    return OmegaConf.to_container(config, resolve=choice.startswith("method"))


def options(name: str, node: Any) -> Iterator[tuple[str, Field, Any]]:
    """Every field of a dataclass at or below `node`, by its name, with its value there."""
    if not isinstance(node, dict):
        return
    target = get_object(node["_target_"]) if "_target_" in node else None
    for field in fields(target) if is_dataclass(target) else ():
        yield f"{name}.{field.name}", field, node.get(field.name, MISSING)
    for key, value in node.items():
        yield from options(f"{name}.{key}", value)


def plain(value: Any) -> Any:
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(x) for key, x in value.items() if not key.startswith("_")}
    return tuple(map(plain, value)) if isinstance(value, list | tuple) else value


def default(field: Field) -> Any:
    return field.default if field.default_factory is MISSING else field.default_factory()


def test_every_scene_has_a_choice():
    embedded = {"totem", "wires", "cloud", "void", "totem_hd"}
    assert choices("scene").keys() == {"blender", "colmap", "nsvf", "transforms", *embedded}


@pytest.mark.parametrize("choice", CHOICES)
def test_a_choice_says_what_it_is_and_composes_to_something_that_exists(choice):
    assert (CONFIGS / f"{choice.replace('=', '/')}.yaml").read_text().startswith("# ")
    assert callable(get_object(node(choice)["_target_"]))


@pytest.mark.parametrize("name", choices("scene"))
def test_a_scene_has_every_option_of_its_loader_and_no_other_default(name):
    config = dict(node(f"scene={name}"))
    parameters = inspect.signature(get_object(config.pop("_target_"))).parameters
    assert config.pop("_convert_") == "all"  # loaders take plain lists
    assert set(config) == set(parameters) - {"log"}
    size = {"width", "height"} if name == "totem_hd" else set()  # larger than the other pictures
    for option in config.keys() - {"root", "bounds"} - size:
        assert parameters[option].default in (config[option], inspect.Parameter.empty)


OF_DATACLASSES = [x for x in CHOICES if x.startswith(("method", "budget", "protocol"))]


@pytest.mark.parametrize("choice", OF_DATACLASSES)
def test_options_stand_there_with_all_their_fields_and_no_other_default(choice):
    there = list(options(choice, node(choice)))
    assert [name for name, _, value in there if value is MISSING] == []
    method = choice.startswith("method")
    compared = {
        name: (plain(default(field)), plain(value))
        for name, field, value in (there if method else ())
        if default(field) is not MISSING
    }
    assert {name: both for name, both in compared.items() if both[0] != both[1]} == {}


@pytest.mark.parametrize("path", SIZES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_a_size_changes_settings_that_are_there(path):
    owner, budget = path.parent.name, f"budget={path.stem}"
    assert path.stem in choices("budget")
    word = USERS.get(owner, f"method={owner}")
    usual = "budget=tiny" if owner == "tables" else "budget=small"  # have no such size
    before, after = (composed([word, of]) for of in (usual, budget))
    group = "tables" if owner == "tables" else word.partition("=")[0]
    assert set(leaves(before[group])) == set(leaves(after[group]))
    assert before[group] != after[group]


def test_a_word_wins_over_what_a_budget_sets_of_a_method():
    assert composed(["method=nerf", "budget=paper", "method.steps=7"]).method.steps == 7


# What our methods declare in their studies: the settings exist, and knobs need no training


METHODS = [name for name, path in choices("method").items() if "_target_" in OmegaConf.load(path)]
"""Those with a class of their own: the others declare what the method does that they vary."""


@cache
def study(name: str) -> Study:
    return Subject(name, [f"method={name}"]).study


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
        assert len(set(map(axis.size, axis.values))) == len(axis.values)
