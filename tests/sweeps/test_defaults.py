"""A default stands once, in the configurations: a dataclass has none, or the same."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field, fields, is_dataclass
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from sweeps.overrides import composed

BASES = (
    *("ngp", "gaussians", "plenoctree", "diver", "kilonerf", "nsvf", "nerf"),
    "steernerf_lean",
)
"""What the other methods' configurations stand on."""


def defaults(name: str, node: Any) -> Iterator[tuple[str, Field, Any]]:
    """Every field of a dataclass at or below `node`, by its name, with the value that it is given
    there."""
    if not isinstance(node, dict):
        return
    target = get_object(node["_target_"]) if "_target_" in node else None
    if is_dataclass(target):
        for field in fields(target):
            if field.name != "name":  # of a method: that of its file, where it is not given
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


def default(field: Field) -> Any:
    """Of a field that has one."""
    return field.default if field.default_factory is MISSING else field.default_factory()


@pytest.mark.parametrize("base", BASES)
def test_the_default_of_a_field_is_the_one_of_the_configuration(base: str) -> None:
    config = OmegaConf.to_container(composed([f"method={base}"]).method, resolve=True)
    compared = {
        name: (plain(default(field)), plain(value))
        for name, field, value in defaults("method", config)
        if default(field) is not MISSING
    }
    assert len(compared) > 5
    assert {name: both for name, both in compared.items() if both[0] != both[1]} == {}
