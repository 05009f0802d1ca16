"""Freed memory is kept, or given back: seen in the page faults of a process of its own."""

from __future__ import annotations

import json
import platform
import subprocess
import sys

import pytest

ROUNDS = """
import json, resource, threading
from bench.allocator import give_back, keep_freed

KEEP
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

PAGES = 3 * (24 << 20) // 4096


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_freed_memory_is_kept_for_any_thread_until_it_is_given_back() -> None:
    first, *again, after = faults_of_steps("keep_freed()")
    assert first > 0.9 * PAGES
    assert max(again) < 0.1 * PAGES
    assert after > 0.9 * PAGES


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_unasked_it_is_mapped_anew_each_time() -> None:
    assert min(faults_of_steps("")) > 0.1 * PAGES


def faults_of_steps(keep: str) -> list[int]:
    """Page faults of three steps on threads of their own, and of one after giving back."""
    program = ROUNDS.replace("KEEP", keep)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, check=True)
    return json.loads(done.stdout)
