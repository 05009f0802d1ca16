"""Work in parallel: order, faults, and torch's threads as they were."""

from __future__ import annotations

from contextlib import nullcontext

import pytest
import torch

from bench.threads import WORKERS, in_parallel


def test_results_keep_their_order_and_are_counted(log) -> None:
    assert in_parallel(lambda x: x * x, range(100), "square", log) == [x * x for x in range(100)]
    assert log.done == 100


def test_the_first_fault_ends_it(log) -> None:
    def work(item: int) -> None:
        if item >= 3:
            raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match=r"^item 3$"):
        in_parallel(work, range(50), "fail", log)
    assert log.done == 3


@pytest.mark.parametrize("fails", [False, True])
def test_torch_has_its_threads_back(log, fails) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    inside = []

    def work(item: int) -> None:
        inside.append(torch.get_num_threads())
        if fails:
            raise ValueError("stop")

    try:
        with pytest.raises(ValueError, match="stop") if fails else nullcontext():
            in_parallel(work, range(WORKERS), "work", log)
        assert set(inside) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
