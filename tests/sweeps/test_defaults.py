"""A default stands once, in the configurations: a dataclass has none, or the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from sweeps.overrides import composed

BASES = ("ngp", "gaussians", "kilonerf", "steernerf_lean")
"""What the other methods' configurations stand on."""


def defaults(name: str, node: Any) -> Iterator[tuple[str, Field, Any]]:
    """Every field of a dataclass at or below `node`, by its name, with the value that it is given
    there."""
    if not isinstance(node, dict):
        return
    target = get_object(node["_target_"]) if "_target_" in node else None
    if is_dataclass(target):
        for field in fields(target):
            yield f"{name}.{field.name}", field, node[field.name]
    for key, value in node.items():
        yield from defaults(f"{name}.{key}", value)


def plain(value: Any) -> Any:
    """Sequences as tuples, of dataclasses the fields."""
    if is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, dict):
        return {key: plain(x) for key, x in value.items() if not key.startswith("_")}
    return tuple(map(plain, value)) if isinstance(value, list | tuple) else value


GIVEN = [
    pytest.param(field, value, id=f"{base}: {name}")
    for base in BASES
    for name, field, value in defaults(
        "method",
        OmegaConf.to_container(composed([f"method={base}"]).method, resolve=True),
    )
]


@pytest.mark.parametrize(("field", "value"), GIVEN)
def test_the_default_of_a_field_is_the_one_of_the_configuration(field: Field, value: Any) -> None:
    if field.default_factory is not MISSING:
        assert plain(field.default_factory()) == plain(value)
    elif field.default is not MISSING:
        assert plain(field.default) == plain(value)


def test_there_are_defaults_to_compare() -> None:
    assert sum(field.default is not MISSING for field, _ in (given.values for given in GIVEN)) > 20
