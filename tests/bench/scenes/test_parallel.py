"""Work in parallel: order, faults, and torch's threads as they were."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable

import pytest
import torch

from bench.scenes.parallel import WORKERS, in_parallel, in_processes
from bench.types import SteerbenchError


@pytest.fixture(params=[in_parallel, in_processes])
def applied(request) -> Callable:
    return request.param


def test_results_keep_their_order_and_are_counted(applied, log) -> None:
    assert applied(lambda x: x * x, range(100), "square", log) == [x * x for x in range(100)]
    assert log.done == 100


def test_the_first_fault_ends_it(applied, log) -> None:
    def work(item: int) -> None:
        if item >= 3:
            raise ValueError(f"item {item}")

    with pytest.raises(ValueError, match=r"^item 3$"):
        applied(work, range(50), "fail", log)
    assert log.done == 3


def test_processes_have_one_thread_and_leave_random_numbers_alone(log) -> None:
    torch.manual_seed(0)
    before = torch.get_rng_state()
    threads = in_processes(lambda _: torch.get_num_threads(), range(4), "count", log)
    assert threads == [1] * 4
    assert torch.equal(torch.get_rng_state(), before)


def test_processes_are_of_their_own(log) -> None:
    assert os.getpid() not in in_processes(lambda _: os.getpid(), range(4), "name", log)


def test_a_process_that_is_killed_is_an_error_for_the_user(log) -> None:
    with pytest.raises(SteerbenchError, match="draw: a process was killed"):
        in_processes(lambda _: os.kill(os.getpid(), signal.SIGKILL), range(4), "draw", log)


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
        if fails:
            with pytest.raises(ValueError, match="stop"):
                in_parallel(work, range(WORKERS), "work", log)
        else:
            in_parallel(work, range(WORKERS), "work", log)
        assert set(inside) == {1}
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
