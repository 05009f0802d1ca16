"""Every nanosecond of a frame is charged once."""

import itertools
import math
from collections.abc import Iterable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bench.clock import FrameRecord, StageClock
from tests.common import refusal


def clock_reading(times: Iterable[int]) -> StageClock:
    """A clock that reads the given times, one at every beginning and end."""
    readings = iter(times)
    return StageClock("cpu", clock=lambda: next(readings))


def test_own_times_of_nested_and_repeated_stages_are_kept_apart():
    clock = clock_reading([100, 101, 103, 107, 115, 131, 163, 227])
    with clock.frame():  # 100
        with clock.stage("field"), clock.stage("encode"):  # 101, 103; 107, 115
            pass
        with clock.stage("field"):  # 131 to 163
            pass
    # 227
    (frame,) = clock.frames
    assert frame.stages_ns == {
        "field": (103 - 101) + (115 - 107) + (163 - 131),
        "field/encode": 107 - 103,
        "other": (101 - 100) + (131 - 115) + (227 - 163),
    }


STAGES = st.recursive(
    st.just(()), lambda inner: st.lists(st.tuples(st.sampled_from("abc"), inner), max_size=4)
)


@given(STAGES, st.lists(st.integers(0, 10**9), min_size=1))
def test_stages_and_other_add_up_to_the_frame_whatever_the_nesting(tree, steps):
    readings = []

    def read():
        readings.append((readings[-1] if readings else 0) + steps[len(readings) % len(steps)])
        return readings[-1]

    clock = StageClock("cpu", clock=read)

    def enter(stages):
        for name, inner in stages:
            with clock.stage(name):
                enter(inner)

    with clock.frame():
        enter(tree)
    (frame,) = clock.frames
    assert frame.total_ns == readings[-1] - readings[0]
    assert all(ns >= 0 for ns in frame.stages_ns.values())


@pytest.mark.parametrize(
    ("stages", "kept"), [(True, {"march": 30, "other": 20}), (False, {"other": 50})]
)
def test_a_time_of_another_clock_replaces_the_stages_beside_what_passed_here(stages, kept):
    readings = iter([100, 160, 170, 190, 191])
    clock = StageClock("worker's cuda", clock=lambda: next(readings), stages=stages)
    with clock.frame():  # 100
        clock.report(50, {"march": 30, "other": 5}, peak_bytes=7, transfer_ns=4)  # 160
        clock.count("rays", 2)
    # 170
    with clock.frame():  # 190 to 191
        pass
    assert clock.frames == [
        FrameRecord(kept, {"rays": 2}, {}, wall_ns=70, peak_bytes=7, transfer_ns=4),
        FrameRecord({"other": 1}, {}, {}),
    ]


@pytest.mark.parametrize(
    ("told", "why"),
    [
        ((61, {}), "at most the 60 ns by the clock here"),
        ((10**400, {}), "below 2"),
        ((-10, {}), "got -10"),
        ((0, {}), "1 or more"),
        ((1.5, {}), r"got 1\.5"),
        ((True, {}), "got True"),
        ((50, {"march": 51}), "at most 50 in all"),
        ((50, {"march": 60, "other": -10}), "got -10"),
        ((50, {}, -1), "peak_bytes"),
    ],
)
def test_a_time_that_cannot_have_passed_is_refused(told, why):
    readings = iter([100, 160])
    clock = StageClock("cpu", clock=lambda: next(readings))
    with refusal(why), clock.frame():
        clock.report(*told)
    assert not clock.frames


def test_a_frame_has_one_reported_time_and_counters_from_0_on():
    clock = clock_reading(itertools.count())
    with clock.frame():
        clock.report(1, {})
        with refusal("twice"):
            clock.report(1, {})
    for wrong in (-1, 2.5, math.nan, 2**63, torch.tensor(-1)):
        with refusal("rays: expected a whole number"), clock.frame():
            clock.count("rays", wrong)


def test_counters_add_up_within_a_frame_and_start_at_0_in_the_next():
    clock = clock_reading(itertools.count())
    with clock.frame():
        clock.count("samples", 3, dense=10)
        clock.count("samples", torch.tensor(4), dense=10)  # as on a GPU
        clock.count("rays", 5)
    with clock.frame():
        clock.count("rays", 1)
    assert clock.frames[0].done == {"samples": 7, "rays": 5}
    assert type(clock.frames[0].done["samples"]) is int
    assert clock.frames[0].dense == {"samples": 20}
    assert clock.frames[1].done == {"rays": 1}
    assert clock.frames[1].dense == {}


def test_a_frame_that_raises_leaves_no_record_and_stages_and_frames_out_of_place_are_refused():
    clock = clock_reading(itertools.count())
    with pytest.raises(KeyError), clock.frame(), clock.stage("field"):
        raise KeyError("from the method")
    with clock.frame():
        pass
    (frame,) = clock.frames
    assert frame.stages_ns == {"other": 1}
    outside = refusal("'field' was entered outside a frame", RuntimeError)
    with outside, clock.stage("field"):
        pass
    with clock.frame():
        with refusal("inside a frame", RuntimeError), clock.frame():
            pass
        with refusal("'other'", ValueError), clock.stage("other"):
            pass


@pytest.mark.parametrize(("stages", "readings"), [(True, 4), (False, 2)])
def test_the_device_finishes_its_work_before_every_reading(monkeypatch, stages, readings):
    events = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: events.append("synchronise"))

    def read():
        events.append("read")
        return len(events)

    clock = StageClock("cuda", clock=read, stages=stages)
    with clock.frame(), clock.stage("field"):
        pass
    assert events == ["synchronise", "read"] * readings
    assert ("field" in clock.frames[0].stages_ns) == stages
