"""The small network: its formula, what it refuses, and that threads do not change it."""

import pytest
import torch
from torch import Tensor

from bench.threads import torch_threads
from methods.kernels.mlp import mlp
from tests.common import assert_near, refusal, seeded


def network(count: int, dtype: torch.dtype = torch.float32) -> tuple[list[Tensor], list[Tensor]]:
    """Two inputs of 5 and 3 channels, and layers of 20 and 4 outputs, which need a gradient."""
    generator = seeded(count)
    inputs = [torch.randn(count, n, generator=generator).to(dtype) for n in (5, 3)]
    layers = [torch.randn(*n, generator=generator).to(dtype) for n in ((20, 8), (4, 20))]
    return inputs, [layer.requires_grad_() for layer in layers]


def test_the_reference_is_the_formula():
    inputs, (first, last) = network(50, torch.float64)
    want = torch.cat(inputs, dim=1).mm(first.T).relu().mm(last.T)
    assert_near(mlp(inputs, [first, last], backend="reference"), want, atol=1e-12)


def test_outputs_depend_on_neither_the_number_of_threads_nor_on_who_asks_for_gradients():
    inputs, layers = network(5000)
    learning = mlp(inputs, layers, backend="cpu")
    with torch.no_grad():
        found = []
        for threads in (1, 2):
            with torch_threads(threads):
                found.append(mlp(inputs, layers, backend="cpu"))
    assert torch.equal(*found)
    # Two sums, of 8 and 20 products, in another order.
    assert_near(found[0], learning.detach(), atol=1e-4)


def test_other_types_numbers_and_shapes_are_refused():
    inputs, layers = network(3)
    with refusal("float64", ValueError):
        mlp(*network(3, torch.float64), backend="cpu")
    for name, given in {
        "inputs": ([*inputs, *inputs], layers),
        "inputs: expected shape": ([inputs[0], inputs[1][:2]], layers),
        "weights: expected shape": (inputs, layers[::-1]),
        "weights": (inputs, []),
    }.items():
        with refusal(name, ValueError):
            mlp(*given)


@pytest.mark.parametrize("sign", [1, -1])
def test_nan_passes_the_relu_whatever_its_sign(backend, sign):
    x = torch.tensor([[sign * torch.nan], [-torch.inf], [-0.0], [torch.inf]]).bfloat16()
    one = torch.ones(1, 1, dtype=torch.bfloat16)
    got = mlp([x], [one, one], backend=backend)[:, 0]
    assert got[0].isnan()
    assert got[1:].tolist() == [0, 0, torch.inf]
