"""The pretended GPU: it refuses what CUDA refuses, and waits where CUDA waits.

The last test plants a bug that only a GPU shows.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from bench.waits import device_waits
from methods.engines.torch_engine import TorchEngine
from methods.kernels.encode import HashGrid, encode
from tests.common import refusal


def there(*values: float) -> Tensor:
    return torch.tensor(values, device="cuda")


HERE = torch.tensor([1.0, 2.0, 3.0])

REFUSED: dict[str, Callable[[], object]] = {
    "a sum with the CPU": lambda: there(1, 2, 3) + HERE,
    "one tensor of both": lambda: torch.stack((there(1).sum(), HERE.sum())),
    "a CPU tensor changed": lambda: torch.zeros(3).add_(there(1, 2, 3)),
    "a CPU tensor's elements": lambda: HERE[there(1).long()],
    "a product by an output": lambda: torch.mul(there(1), 2, out=torch.zeros(1)),
    "numpy": lambda: there(1).numpy(),
    "an array": lambda: np.asarray(there(1)),
    "random numbers of the CPU": lambda: torch.rand(2, generator=torch.Generator(), device="cuda"),
    "random numbers for the CPU": lambda: torch.rand(2, generator=torch.Generator("cuda")),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_cuda_refuses_is_refused(gpu, what):
    with pytest.raises((RuntimeError, TypeError), match=r"same device|to numpy|generator"):
        REFUSED[what]()


def test_a_triton_kernel_takes_no_tensor_of_the_cpu(gpu):
    pytest.importorskip("triton")
    grid = HashGrid(levels=1, features=2, log2_table=6, n_min=4, n_max=4)
    table, positions = torch.ones(grid.entries, 2), torch.full((2, 3), 0.5).cuda()
    assert encode(positions, table.cuda(), grid, backend="gpu").tolist() == [[1, 1], [1, 1]]
    with refusal("cannot be accessed from Triton", ValueError):
        encode(positions, table, grid, backend="gpu")


def masked(x: Tensor, value: float | Tensor, mask: Tensor) -> None:
    x[mask] = value


WAITS: dict[str, tuple[int, Callable[[Tensor], object]]] = {
    "arithmetic": (0, lambda x: (x + 1).sum() * 2),
    "item": (1, lambda x: x.sum().item()),
    "a condition": (1, lambda x: 1 if (x > 0).any() else 0),
    "tolist": (1, lambda x: x.tolist()),
    "cpu": (1, lambda x: x.cpu()),
    "from the CPU": (1, lambda x: x.copy_(HERE)),
    "from the CPU, not to wait for": (0, lambda x: HERE.to("cuda", non_blocking=True)),
    "a constant": (1, lambda x: torch.tensor(0.5, device="cuda")),
    "a constant that is filled in": (0, lambda x: x.new_full((1,), 0.5)),
    "nonzero": (1, lambda x: x.nonzero()),
    "nonzero, how many is known": (0, lambda x: torch.nonzero_static(x, size=3)),
    "a mask": (1, lambda x: x[x > 0]),
    "two masks": (2, lambda x: x.expand(3, 3)[x > 0, x > 0]),
    "indices": (0, lambda x: x[x.long() % 3]),
    "indices from the CPU": (1, lambda x: x[HERE.long() % 3]),
    "a mask that is filled": (0, lambda x: masked(x, 0.0, x > 0)),
    "where": (0, lambda x: torch.where(x > 0, x, 0.0)),
    "where, with a number of the CPU": (1, lambda x: torch.where(x > 0, x, HERE.sum())),
    "unique": (1, lambda x: x.unique()),
    "repeated by a tensor": (1, lambda x: x.repeat_interleave(x.long())),
    "repeated, how often is known": (0, lambda x: x.repeat_interleave(x.long(), output_size=6)),
}


@pytest.mark.parametrize("what", WAITS)
def test_the_host_waits_as_often_as_for_cuda(gpu, what):
    expected, act = WAITS[what]
    x = there(1, 2, 3)
    with device_waits() as waits:
        act(x)
    assert waits.total() == expected


def test_the_host_waits_for_a_moment_unless_it_has_waited_since(gpu):
    x = there(1, 2, 3)
    moment = torch.cuda.current_stream().record_event()
    with device_waits() as waits:
        moment.synchronize()
        moment.synchronize()
    assert waits.total() == 1
    moment = torch.cuda.current_stream().record_event()
    x.tolist()
    with device_waits() as waits:
        moment.synchronize()
    assert not waits


def test_told_to_raise_it_raises_where_it_would_wait(gpu):
    torch.cuda.set_sync_debug_mode("error")
    with refusal("synchronizing", RuntimeError):
        there(1)


@pytest.mark.parametrize("enabled", [True, False])
def test_autocast_lowers_products(gpu, enabled):
    x = torch.eye(2, device="cuda", requires_grad=True)
    with torch.autocast("cuda", torch.bfloat16, enabled=enabled):
        product = x @ x
    product.float().sum().backward()
    assert product.dtype == (torch.bfloat16 if enabled else torch.float32)
    assert x.grad.dtype == torch.float32


class Asking(nn.Linear):
    """A network that asks for a number."""

    def forward(self, x):
        return x * self.bias.item()


def test_planted_a_wait_in_a_network_is_found(gpu, tmp_path, quiet_log):
    built = TorchEngine().build(Asking(1, 1).to("cuda"), list, lambda: tmp_path, quiet_log)
    with refusal("stream is capturing", RuntimeError):
        built.run(torch.ones(1, 3, 4, 4, device="cuda"))
