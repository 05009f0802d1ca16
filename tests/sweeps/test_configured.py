"""Building from a configuration: settings are checked by name and type before anything runs."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal

import pytest
from omegaconf import OmegaConf

from bench.errors import SteerbenchError
from sweeps.configured import build, check_settings
from sweeps.overrides import composed, target_of


@dataclass
class Inner:
    """A nested part."""

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


@pytest.fixture(autouse=True)
def targets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the classes above importable by name."""
    module = ModuleType("targets")
    module.Inner, module.Outer = Inner, Outer
    monkeypatch.setitem(sys.modules, "targets", module)


def built(*overrides: str) -> Outer:
    """`Outer` from a configuration with `overrides`."""
    node = {
        "_target_": "targets.Outer",
        "inner": {"_target_": "targets.Inner", "size": 3},
    }
    config = OmegaConf.merge({"thing": node}, OmegaConf.from_dotlist(list(overrides)))
    return build(config, "thing", "from the caller", log="a log")


def test_nested_parts_and_what_the_caller_gives_arrive():
    assert built() == Outer("from the caller", Inner(3), log="a log")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("thing.rate=1", {"rate": 1}),
        ("thing.rate=2.5e-3", {"rate": 2.5e-3}),
        ("thing.path=some/where", {"path": "some/where"}),
        ("thing.flag=true", {"flag": True}),
        ("thing.limits=[1, 2.5]", {"limits": [1, 2.5]}),
        ("thing.inner.kind=square", {"inner": Inner(3, "square")}),
    ],
)
def test_a_fitting_setting_is_taken(override, expected):
    outer = built(override)
    assert {name: getattr(outer, name) for name in expected} == expected


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("thing.rate=fast", r"thing\.rate: expected float, got 'fast'"),
        ("thing.rate=true", r"thing\.rate: expected float, got True"),
        ("thing.flag=1", r"thing\.flag: expected bool, got 1"),
        ("thing.path=7", r"thing\.path: expected str \| Path, got 7"),
        ("thing.limits=3", r"thing\.limits: expected tuple\[float, \.\.\.\], got 3"),
        ("thing.inner.size=2.5", r"thing\.inner\.size: expected int, got 2\.5"),
        ("thing.inner.kind=oval", r"thing\.inner\.kind: expected round or square, got 'oval'"),
        (
            "thing.inner.sizes=2",
            r"unknown setting 'thing\.inner\.sizes'. Did you mean thing\.inner",
        ),
        ("thing.ratte=2", r"unknown setting 'thing\.ratte'. Did you mean thing\.rate\?"),
        ("thing.log=mine", r"unknown setting 'thing\.log'"),
        ("thing.first=mine", r"unknown setting 'thing\.first'"),
        ("thing.path=???", r"thing\.path is not set: give thing\.path="),
        ("thing.inner.size=-1", "size: expected 0 or more"),
        ("thing.rate=-0.5", "thing: rate: expected 0 or more"),
    ],
)
def test_a_setting_that_does_not_fit_is_named_in_full(override, message):
    with pytest.raises(SteerbenchError, match=message):
        built(override)


def test_a_dataclass_may_have_fields_of_types_that_only_the_module_of_its_base_knows(monkeypatch):
    base = ModuleType("base_of_targets")
    source = """
from __future__ import annotations
from dataclasses import dataclass
from decimal import Decimal
@dataclass
class Base:
    exact: Decimal | None = None
    flag: bool = False
"""
    monkeypatch.setitem(sys.modules, base.__name__, base)
    base.__dict__["__name__"] = base.__name__
    exec(source, base.__dict__)

    @dataclass
    class Options(base.Base):
        more: int = 0

    check_settings(Options, {"more": 3})
    with pytest.raises(SteerbenchError, match="flag: expected bool, got 'much'"):
        check_settings(Options, {"flag": "much"})


@pytest.mark.parametrize("name", ["nowhere.Method", "bench.types.Nothing", "..", "bench.nothing.X"])
def test_a_target_that_cannot_be_imported_is_named(name):
    with pytest.raises(SteerbenchError, match=f"cannot import {re.escape(name)}: .*PYTHONPATH"):
        target_of({"_target_": name})


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["~method.grid"], ".grid is not set: give method.grid=..."),
        (["method.model.scale=8"], "use renderer.init=scratch"),
        (["method.renderer.width=0"], "renderer.width: expected 1 to 4096, got 0"),
        (["method.joint.opacity_entropy=-1"], "joint.opacity_entropy: expected 0 or more, got -1"),
    ],
)
def test_what_field_and_renderer_cannot_do_is_refused_before_any_training(overrides, message):
    config = composed(["method=steernerf_lean", *overrides])
    with pytest.raises(SteerbenchError, match=rf"^method.*{re.escape(message)}"):
        build(config, "method")
