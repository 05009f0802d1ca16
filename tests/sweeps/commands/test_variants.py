"""Variants on common ground: which can be used, and what is refused before anything is trained."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from bench.errors import SteerbenchError, Unavailable
from bench.trajectories import Step, Trajectory
from sweeps.overrides import composed
from sweeps.variants import common_ground, fit_each, usable

SMALL = ("scene=totem", "scene.width=16", "scene.train=2", "scene.test=2", "trajectory=test")


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The engines that were fitted; those that are called "absent" cannot be used."""
    names: list[str] = []

    def build(config: SimpleNamespace, group: str) -> object:
        if group == "method" and config.engine == "absent":
            raise Unavailable("it is not installed")
        return SimpleNamespace(memory=0, fit=lambda *arguments: names.append(config.engine))

    monkeypatch.setattr("sweeps.variants.build", build)
    return names


def configs(*engines: str) -> dict[str, SimpleNamespace]:
    return {str(n): SimpleNamespace(seed=0, engine=engine) for n, engine in enumerate(engines)}


def path(truth: int | None) -> Trajectory:
    return Trajectory("path", "test", (Step(SimpleNamespace(), truth),))


def test_what_cannot_be_used_is_left_out(fitted, quiet_log):
    found = configs("one", "absent", "other")
    methods = usable(found, quiet_log)
    assert list(methods) == ["0", "2"]
    fit_each(methods, found, None, path(0), quiet_log)
    assert fitted == ["one", "other"]


def test_without_the_first_there_is_nothing_to_compare_with(fitted, quiet_log):
    with pytest.raises(Unavailable):
        usable(configs("absent", "other"), quiet_log)


def test_a_path_without_truth_is_refused_before_anything_is_trained(fitted, quiet_log):
    found = configs("one")
    methods = usable(found, quiet_log)
    with pytest.raises(SteerbenchError, match="give more frames"):
        fit_each(methods, found, None, path(None), quiet_log)
    assert fitted == []


def test_a_protocol_that_forgets_between_frames_is_refused(tmp_path):
    config = composed([*SMALL, f"outputs={tmp_path}", "protocol.memory=cold", "protocol.name=cold"])
    with pytest.raises(SteerbenchError, match=r"protocol\.memory: expected steady"):
        common_ground(config, 2)


def test_pictures_too_small_for_lpips_are_not_refused_where_it_is_not_computed(tmp_path):
    _, found, protocol = common_ground(composed([*SMALL, f"outputs={tmp_path}"]), 1)
    assert len(found.steps) == 1
    assert protocol.lpips == ()
