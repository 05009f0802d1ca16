"""Work in parallel: order, faults, torch's threads as they were."""

import torch

from bench.threads import in_parallel
from tests.common import refusal


def test_results_keep_their_order_and_are_counted(log):
    assert in_parallel(lambda x: x * x, range(100), "square", log) == [x * x for x in range(100)]
    assert log.done == 100


def test_the_first_fault_ends_it_and_torch_has_its_threads_back(log):
    before, inside = torch.get_num_threads(), []
    torch.set_num_threads(2)

    def work(item):
        inside.append(torch.get_num_threads())
        if item >= 3:
            raise ValueError(f"item {item}")

    try:
        with refusal(r"^item 3$", ValueError):
            in_parallel(work, range(50), "fail", log)
        assert (log.done, set(inside), torch.get_num_threads()) == (3, {1}, 2)
    finally:
        torch.set_num_threads(before)
