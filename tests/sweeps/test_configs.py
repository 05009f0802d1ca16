"""What can be set stands in the configurations, where `steerbench run --help` shows it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import pytest
from hydra.utils import get_object
from omegaconf import OmegaConf

from sweeps.overrides import CONFIGS, composed

CHOICES = [
    f"{group}={path.stem}"
    for group in ("method", "budget", "protocol")
    for path in sorted((CONFIGS / group).glob("*.yaml"))
]


def options(name: str, node: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Every node of options at or below `node`, by its name."""
    if isinstance(node, dict):
        if "_target_" in node and is_dataclass(get_object(node["_target_"])):
            yield name, node
        for key, value in node.items():
            yield from options(f"{name}.{key}", value)


@pytest.mark.parametrize("choice", CHOICES)
def test_options_stand_there_with_all_their_fields(choice: str) -> None:
    group = choice.partition("=")[0]
    config = OmegaConf.to_container(composed([choice])[group], resolve=False)
    for name, node in options(group, config):
        expected = {field.name for field in fields(get_object(node["_target_"]))}
        assert {key for key in node if not key.startswith("_")} == expected, name
