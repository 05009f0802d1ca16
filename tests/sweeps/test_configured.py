"""Building from a configuration: settings are checked by name and type before anything runs."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pytest
from omegaconf import OmegaConf

from bench.errors import SteerbenchError
from bench.types import Scene
from sweeps import configured
from sweeps.configured import build, protocol_of
from sweeps.overrides import composed, target_of
from tests.common import refusal


@dataclass
class Inner:
    size: int
    kind: Literal["round", "square"] = "round"

    def __post_init__(self) -> None:
        if self.size < 0:
            raise SteerbenchError("size: expected 0 or more")


@dataclass
class Outer:
    """What is built: `first` and `log` come from the caller."""

    first: str
    inner: Inner
    path: str | Path = ""
    rate: float = 0.1
    flag: bool = False
    limits: tuple[float, ...] = ()
    log: object = None

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise ValueError("rate: expected 0 or more")


def built(*overrides: str) -> Outer:
    inner = {"_target_": f"{__name__}.Inner", "size": 3}
    node = {"thing": {"_target_": f"{__name__}.Outer", "inner": inner}}
    config = OmegaConf.merge(node, OmegaConf.from_dotlist([f"thing.{one}" for one in overrides]))
    return build(config, "thing", "from the caller", log="a log")


def test_what_fits_arrives_and_nested_parts_and_what_the_caller_gives():
    assert built() == Outer("from the caller", Inner(3), log="a log")
    fitting = ("rate=1", "path=some/where", "flag=true", "limits=[1, 2.5]", "inner.kind=square")
    others = ("some/where", 1, True, [1, 2.5], "a log")
    assert built(*fitting) == Outer("from the caller", Inner(3, "square"), *others)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("rate=fast", "thing.rate: expected float, got 'fast'"),
        ("rate=true", "thing.rate: expected float, got True"),
        ("flag=1", "thing.flag: expected bool, got 1"),
        ("path=7", "thing.path: expected str | Path, got 7"),
        ("limits=3", "thing.limits: expected tuple[float, ...], got 3"),
        ("inner.size=2.5", "thing.inner.size: expected int, got 2.5"),
        ("inner.kind=oval", "thing.inner.kind: expected round or square, got 'oval'"),
        ("inner.sizes=2", "unknown setting 'thing.inner.sizes'. Did you mean thing.inner"),
        ("ratte=2", "unknown setting 'thing.ratte'. Did you mean thing.rate?"),
        ("log=mine", "unknown setting 'thing.log'"),
        ("first=mine", "unknown setting 'thing.first'"),
        ("path=???", "thing.path is not set: give thing.path="),
        ("inner.size=-1", "size: expected 0 or more"),
        ("rate=-0.5", "thing: rate: expected 0 or more"),
    ],
)
def test_a_setting_that_does_not_fit_is_named_in_full(override, message):
    with refusal(re.escape(message)):
        built(override)


@pytest.mark.parametrize("name", ["nowhere.Method", "bench.types.Nothing", "..", "bench.nothing.X"])
def test_a_target_that_cannot_be_imported_is_named(name):
    with refusal(f"cannot import {re.escape(name)}: .*PYTHONPATH"):
        target_of({"_target_": name})


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["~method.grid"], ".grid is not set: give method.grid=..."),
        (["method.rendering.stop=much"], ".stop: expected float, got 'much'"),  # of a base class
        (["method.renderer.width=0"], "renderer.width: expected 1 to 4096, got 0"),
        (["method.joint.opacity_entropy=-1"], "joint.opacity_entropy: expected 0 or more, got -1"),
    ],
)
def test_what_field_and_renderer_cannot_do_is_refused_before_any_training(overrides, message):
    config = composed(["method=steernerf", *overrides])
    with refusal(rf"^method.*{re.escape(message)}"):
        build(config, "method")


def test_a_changed_standard_protocol_needs_a_name_of_its_own():
    assert protocol_of(composed([])).name == "steerbench-1"
    with refusal(r"protocol\.warmup differs from what steerbench-1"):
        protocol_of(composed(["protocol.warmup=1"]))
    with pytest.raises(SteerbenchError, match=r"protocol\.mask differs from what study-1 says"):
        protocol_of(composed(["protocol=study-1", "protocol.mask=none"]))
    assert protocol_of(composed(["protocol=study-1", "protocol.rounds=1"])).rounds == 1
    assert protocol_of(composed(["protocol.warmup=1", "protocol.name=cool"])).warmup == 1


def test_a_scene_that_names_no_files_is_read_each_time(tiny_scene, monkeypatch):
    """Nobody knows what it was read from."""
    config = composed([])
    reads = []

    def read(*_: object, **__: object) -> Scene:
        reads.append(1)
        return replace(tiny_scene, files=reads_from)

    monkeypatch.setattr(configured, "build", read)
    for reads_from in ((Path(__file__),), ()):
        configured.forget_scene()
        reads.clear()
        for _ in range(2):
            configured.scene_of(config)
        assert (len(reads) == 1) == bool(reads_from)
    configured.forget_scene()
