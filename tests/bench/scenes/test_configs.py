"""The scene configurations say what their loaders take, no more and no less."""

from __future__ import annotations

import inspect
from importlib import import_module
from pathlib import Path

import pytest
from omegaconf import OmegaConf

import sweeps

CONFIGS = sorted((Path(sweeps.__file__).parent / "configs" / "scene").glob("*.yaml"))


def test_every_scene_has_one() -> None:
    names = {path.stem for path in CONFIGS}
    assert names == {
        *("blender", "colmap", "nsvf", "transforms"),  # of files
        *("totem", "wires", "cloud", "void", "medley"),  # embedded
    }


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_it_holds_every_option_of_its_loader(path: Path) -> None:
    config = OmegaConf.to_container(OmegaConf.load(path))
    assert isinstance(config, dict)
    module, function = config.pop("_target_").rsplit(".", 1)
    assert config.pop("_convert_") == "all"  # loaders take plain lists
    parameters = inspect.signature(getattr(import_module(module), function)).parameters
    unused = {"log"} if path.stem == "medley" else {"log", "variant"}  # of medley alone
    assert set(config) == set(parameters) - unused
    defaults = {
        name: parameter.default
        for name, parameter in parameters.items()
        if parameter.default is not inspect.Parameter.empty
        and name not in (*unused, "root", "bounds", "variant")
    }
    assert {name: config[name] for name in defaults} == defaults
