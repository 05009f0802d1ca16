"""Every nanosecond of a frame is charged once, every region is metered, every wait has its line."""

from __future__ import annotations

import itertools
import linecache
import mmap
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bench import probes
from bench.errors import Unavailable
from bench.probes import FrameRecord, MemoryMeter, StageClock, device_waits, p99_to_p50


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

    def read() -> int:
        readings.append((readings[-1] if readings else 0) + steps[len(readings) % len(steps)])
        return readings[-1]

    clock = StageClock("cpu", clock=read)

    def enter(stages) -> None:
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
def test_a_time_of_another_clock_replaces_the_stages_and_leaves_that_until_then(stages, kept):
    readings = iter([100, 103, 110, 190, 191])
    clock = StageClock("worker's cuda", clock=lambda: next(readings), stages=stages)
    with clock.frame():  # 100
        clock.report(50, {"march": 30, "other": 5}, peak_bytes=7)  # 103
        clock.count("rays", 2)
    with clock.frame():  # 190 to 191
        pass
    assert clock.frames == [
        FrameRecord(kept, {"rays": 2}, {}, wall_ns=3, peak_bytes=7),
        FrameRecord({"other": 1}, {}, {}),
    ]


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
    outside = pytest.raises(RuntimeError, match="'field' was entered outside a frame")
    with outside, clock.stage("field"):
        pass
    with clock.frame():
        with pytest.raises(RuntimeError, match="inside a frame"), clock.frame():
            pass
        with pytest.raises(ValueError, match="'other'"), clock.stage("other"):
            pass


@pytest.mark.parametrize(("stages", "readings"), [(True, 4), (False, 2)])
def test_the_device_finishes_its_work_before_every_reading(monkeypatch, stages, readings):
    events = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: events.append("synchronise"))

    def read() -> int:
        events.append("read")
        return len(events)

    clock = StageClock("cuda", clock=read, stages=stages)
    with clock.frame(), clock.stage("field"):
        pass
    assert events == ["synchronise", "read"] * readings
    assert ("field" in clock.frames[0].stages_ns) == stages


def test_the_longest_frames_are_held_against_the_median():
    records = [FrameRecord({"field": ms * 1_000_000}, {}, {}) for ms in (10, 10, 40)]
    assert p99_to_p50(records) == pytest.approx(3.94)  # 10 + 0.98 x 30, of 10


SIZE = 64 << 20
SLACK = 8 << 20  # the kernel adds up resident pages in batches for every core


def test_the_peak_of_a_region_is_what_it_touches_and_the_highest_of_several_is_kept():
    meter, idle = MemoryMeter("cpu"), MemoryMeter("cpu")
    with meter, mmap.mmap(-1, SIZE) as fresh:  # an allocator may have some bytes left to give
        for page in range(0, SIZE, mmap.PAGESIZE):
            fresh[page] = 1
    first = meter.peak_bytes
    with idle:  # it knows nothing of what was freed before
        pass
    with meter:
        pass
    assert first >= idle.peak_bytes + SIZE - SLACK
    assert meter.peak_bytes == first


def test_the_source_says_when_the_peak_includes_what_came_before(monkeypatch):
    assert "while rendering" in MemoryMeter("cpu").source
    # In some sandboxes the status of a process has fewer lines.
    monkeypatch.setattr(Path, "read_text", lambda path: "VmRSS: 1 kB\n")
    with (meter := MemoryMeter("cpu")):
        pass
    assert meter.peak_bytes > 1 << 20
    monkeypatch.setattr(probes, "_reset_high_water_mark", lambda: False)
    assert "since it began" in MemoryMeter("cpu").source


def test_on_a_gpu_the_meter_reads_the_allocator(monkeypatch):
    calls = []
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: calls.append("reset"))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 12345)
    meter = MemoryMeter("cuda")
    with meter:
        assert calls == ["reset"]
    assert meter.peak_bytes == 12345
    assert "device" in meter.source


def test_the_line_that_waits_or_calls_what_waits_in_torch_is_named(gpu):
    x = torch.ones(3, device="cuda")
    with device_waits() as waits:
        for _ in range(2):
            torch.unique(x)
    ((line, count),) = waits.items()
    assert (line.path, count) == (__file__, 2)
    assert linecache.getline(*line).strip() == "torch.unique(x)"
    scope: dict[str, Any] = {}
    text = "def wait():\n import warnings\n warnings.warn('called a synchronizing CUDA operation')"
    exec(compile(text, torch.functional.__file__, "exec"), scope)
    with device_waits() as waits:
        scope["wait"]()
    ((line, count),) = waits.items()
    assert (line.path, count) == (__file__, 1)


def test_a_wait_in_a_backward_pass_is_that_of_its_line(gpu):
    class Asking(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            return x.clone()

        @staticmethod
        def backward(ctx, grad):
            return grad * grad.max().item()

    x = torch.ones(3, device="cuda", requires_grad=True)
    y = Asking.apply(x).sum()
    with device_waits() as waits:
        y.backward()
    ((line, count),) = waits.items()
    assert (line.number, count) == (Asking.backward.__code__.co_firstlineno + 2, 1)


def test_other_warnings_are_shown_as_ever_and_afterwards_none_is_counted(gpu):
    with pytest.warns(UserWarning, match="of something else"), device_waits() as waits:
        warnings.warn("of something else", stacklevel=1)
    torch.ones(1, device="cuda").item()
    assert not waits
    assert torch.cuda.get_sync_debug_mode() == 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="for a machine without a GPU")
def test_without_a_gpu_it_says_that_one_is_needed():
    with pytest.raises(Unavailable, match="a GPU is needed"), device_waits():
        pass
