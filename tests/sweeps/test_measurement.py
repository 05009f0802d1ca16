"""Measurements of several methods in turns, and what the store has of them."""

from __future__ import annotations

import pytest

from sweeps.measurement import Job, obtain, stored
from sweeps.overrides import composed
from tests.sweeps.conftest import STAND_INS

pytestmark = pytest.mark.usefixtures("elsewhere")


def jobs(*levels: float, turns: str = "table") -> list[Job]:
    configs = [composed([*STAND_INS, f"method.level={level}"]) for level in levels]
    return [Job(config, [], turns=turns) for config in configs]


def measured(*levels: float, turns: str = "table") -> bool:
    """Whether the jobs of the levels had to be measured."""
    return obtain(jobs(*levels, turns=turns))[1]


def test_lines_that_are_measured_in_turns_are_found_together_or_not_at_all():
    """A table of times must not have one line of today beside one of last week."""
    assert measured(0.5, 0.75)
    assert len(stored(jobs(0.5, 0.75))) == 2
    assert stored(jobs(0.5, 0.25)) == []
    assert measured(0.5, 0.25)
    assert not measured(0.75, 0.5)


def test_what_an_interruption_left_of_a_group_is_measured_again_with_the_rest():
    store = jobs(0.5)[0].store
    (first, second), _ = obtain(jobs(0.5, 0.75))
    mark = store.folder / first / "of yesterday"
    mark.touch()
    store.remove(second)
    assert stored(jobs(0.5, 0.75)) == []
    assert measured(0.5, 0.75)
    assert not mark.exists()
    assert stored(jobs(0.5, 0.75)) == [first, second]


def test_a_line_alone_is_another_run_than_the_same_in_turns():
    (alone,), _ = obtain(jobs(0.5, turns=""))
    assert alone not in obtain(jobs(0.5, 0.75))[0]
    assert not measured(0.5, turns="")


def test_a_failure_is_kept_for_its_job_until_that_succeeds():
    (job,), (other,) = jobs(0.5, turns=""), jobs(0.75, turns="")
    job.keep_failure("no room")
    assert (job.failure, other.failure) == ("no room", None)
    obtain([job])
    assert job.failure is None
