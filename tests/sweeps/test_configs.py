"""Settings are in the configurations, each once, and a size changes only those that are there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from functools import cache
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from sweeps.overrides import CONFIGS, choices, composed, leaves

GROUPS = ("method", "scene", "trajectory", "protocol", "budget")
CHOICES = [f"{group}={name}" for group in GROUPS for name in choices(group)]
SIZES = sorted((CONFIGS / "size").glob("*/*.yaml"))
USERS = {"field": "method=ngp", "unet": "method=steernerf", "tables": "method=ngp"}
"""Of sizes that are not of one method: a word that chooses what takes them in."""


@cache
def node(choice: str, *words: str) -> dict[str, Any]:
    """The node of a choice as a run has it."""
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
    """Sequences as tuples, of dataclasses the fields."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(x) for key, x in value.items() if not key.startswith("_")}
    return tuple(map(plain, value)) if isinstance(value, list | tuple) else value


def default(field: Field) -> Any:
    """Of a field that has one."""
    return field.default if field.default_factory is MISSING else field.default_factory()


@pytest.mark.parametrize("choice", CHOICES)
def test_a_choice_says_what_it_is_and_composes_to_something_that_exists(choice):
    assert (CONFIGS / f"{choice.replace('=', '/')}.yaml").read_text().startswith("# ")
    assert callable(get_object(node(choice)["_target_"]))


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
    before, after = (composed([word, of]) for of in ("budget=pretrain", budget))
    group = "tables" if owner == "tables" else "method"
    assert set(leaves(before[group])) == set(leaves(after[group]))
    assert before[group] != after[group]


@pytest.mark.parametrize(
    ("words", "steps"),
    [([], None), (["budget=paper"], 300), (["budget=paper", "method.steps=7"], 7)],
)
def test_a_budget_changes_a_setting_of_a_method_and_a_word_wins(words, steps):
    assert composed(["method=nerf", *words]).method.steps == steps
