"""Measurements of several methods in turns, and what the store has of them."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from omegaconf import DictConfig

from sweeps.measurement import Obtained, obtain_in_turns, stored
from sweeps.overrides import composed
from tests.sweeps.conftest import HERE, QUICK


def asked(*words: str) -> tuple[DictConfig, Sequence[str]]:
    config = composed([f"--config-dir={HERE / 'configs'}", *QUICK, *words])
    return config, ["steerbench", "run", *words]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(HERE)


def measured(found: Sequence[Obtained]) -> list[bool]:
    return [one.measured for one in found]


def test_lines_that_are_measured_in_turns_are_found_together_or_not_at_all() -> None:
    """A table of times must not have one line of today beside one of last week."""
    grey, light, dark = (asked(f"method.level={level}") for level in (0.5, 0.75, 0.25))
    assert measured(obtain_in_turns([grey, light], "table")) == [True, True]
    assert measured(stored([grey, light], "table")) == [False, False]
    assert stored([grey, dark], "table") == []
    assert measured(obtain_in_turns([grey, dark], "table")) == [True, True]
    assert measured(obtain_in_turns([light, grey], "table")) == [False, False]


def test_a_line_alone_is_found_whatever_was_measured_beside_it() -> None:
    grey, light = asked("method.level=0.5"), asked("method.level=0.75")
    obtain_in_turns([grey, light])
    assert len(stored([grey])) == len(stored([light])) == 1
