"""Every region is metered; freed memory is kept until it is given back."""

import json
import mmap
import platform
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bench import memory
from bench.memory import MemoryMeter

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
    monkeypatch.setattr(memory, "_reset_high_water_mark", lambda: False)
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


# Page faults of three steps on threads of their own, and of one after giving back.
ROUNDS = """
import json, resource, threading
from bench.memory import give_back, keep_freed

keep_freed()
faults = []

def step():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    pieces = [b"1" * (24 << 20) for _ in range(3)]
    del pieces
    faults.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

for _ in range(3):
    thread = threading.Thread(target=step)
    thread.start()
    thread.join()
give_back()
step()
print(json.dumps(faults))
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_freed_memory_is_kept_for_any_thread_until_it_is_given_back():
    done = subprocess.run([sys.executable, "-c", ROUNDS], capture_output=True, check=True)
    first, *again, after = json.loads(done.stdout)
    assert max(again) < first / 2
    assert after > first / 2
