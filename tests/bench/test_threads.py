"""Work in parallel: order, faults, torch's threads as they were, memory for any of them."""

from __future__ import annotations

import json
import platform
import subprocess
import sys

import pytest
import torch

from bench.threads import in_parallel


def test_results_keep_their_order_and_are_counted(log) -> None:
    assert in_parallel(lambda x: x * x, range(100), "square", log) == [x * x for x in range(100)]
    assert log.done == 100


def test_the_first_fault_ends_it_and_torch_has_its_threads_back(log) -> None:
    before, inside = torch.get_num_threads(), []
    torch.set_num_threads(2)

    def work(item: int) -> None:
        inside.append(torch.get_num_threads())
        if item >= 3:
            raise ValueError(f"item {item}")

    try:
        with pytest.raises(ValueError, match=r"^item 3$"):
            in_parallel(work, range(50), "fail", log)
        assert (log.done, set(inside), torch.get_num_threads()) == (3, {1}, 2)
    finally:
        torch.set_num_threads(before)


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
