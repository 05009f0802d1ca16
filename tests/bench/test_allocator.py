"""Freed memory is kept, or given back: seen in the page faults of a process of its own."""

from __future__ import annotations

import json
import platform
import subprocess
import sys

import pytest

# Page faults of three steps on threads of their own, and of one after giving back.
ROUNDS = """
import json, resource, threading
from bench.allocator import give_back, keep_freed

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
def test_freed_memory_is_kept_for_any_thread_until_it_is_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", ROUNDS], capture_output=True, check=True)
    first, *again, after = json.loads(done.stdout)
    assert max(again) < first / 2
    assert after > first / 2
