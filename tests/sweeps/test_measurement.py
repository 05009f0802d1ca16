"""Measurements of several methods in turns, and what the store has of them."""

from __future__ import annotations

import pytest

from sweeps.measurement import Group, Job, Obtained, obtain, stored
from sweeps.overrides import composed
from tests.sweeps.conftest import HERE, QUICK


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(HERE)


def group(*levels: float, turns: str = "table") -> Group:
    words = [[*QUICK, f"method.level={level}"] for level in levels]
    configs = [composed([f"--config-dir={HERE / 'configs'}", *each]) for each in words]
    return Group([Job(config, []) for config in configs], turns)


def measured(runs: list[Obtained]) -> list[bool]:
    return [each.measured for each in runs]


def test_lines_that_are_measured_in_turns_are_found_together_or_not_at_all():
    """A table of times must not have one line of today beside one of last week."""
    assert measured(obtain(group(0.5, 0.75))) == [True, True]
    assert measured(stored(group(0.5, 0.75))) == [False, False]
    assert stored(group(0.5, 0.25)) == []
    assert measured(obtain(group(0.5, 0.25))) == [True, True]
    assert measured(obtain(group(0.75, 0.5))) == [False, False]


def test_what_an_interruption_left_of_a_group_is_measured_again_with_the_rest():
    first, second = obtain(group(0.5, 0.75))
    mark = first.store.folder / first.run / "of yesterday"
    mark.touch()
    second.store.remove(second.run)
    assert stored(group(0.5, 0.75)) == []
    assert measured(obtain(group(0.5, 0.75))) == [True, True]
    assert not mark.exists()
    assert measured(stored(group(0.5, 0.75))) == [False, False]


def test_a_line_alone_is_another_run_than_the_same_in_turns():
    (alone,) = obtain(group(0.5, turns=""))
    assert alone.run not in {run.run for run in obtain(group(0.5, 0.75))}
    assert measured(obtain(group(0.5, turns=""))) == [False]
