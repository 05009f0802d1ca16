"""The small network: its formula, what it refuses, and that threads do not change it."""

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.threads import torch_threads
from methods.kernels.mlp import mlp
from tests.common import assert_near, seeded


def network(count: int, dtype: torch.dtype = torch.float32) -> tuple[list[Tensor], list[Tensor]]:
    """Two inputs of 5 and 3 channels, and layers of 20 and 4 outputs, which need a gradient."""
    generator = seeded(count)
    inputs = [torch.randn(count, n, generator=generator).to(dtype) for n in (5, 3)]
    layers = [torch.randn(*n, generator=generator).to(dtype) for n in ((20, 8), (4, 20))]
    return inputs, [layer.requires_grad_() for layer in layers]


def test_the_reference_is_the_formula():
    inputs, layers = network(50, torch.float64)
    first, last = (layer.detach().numpy() for layer in layers)
    x = np.concatenate([part.numpy() for part in inputs], axis=1)
    want = np.einsum("oh,sh->so", last, np.maximum(np.einsum("hi,si->sh", first, x), 0))
    got = mlp(inputs, layers, backend="reference").detach().numpy()
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-12)


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
    with pytest.raises(ValueError, match="float64"):
        mlp(*network(3, torch.float64), backend="cpu")
    for name, given in {
        "inputs": ([*inputs, *inputs], layers),
        "inputs: expected shape": ([inputs[0], inputs[1][:2]], layers),
        "weights: expected shape": (inputs, layers[::-1]),
        "weights": (inputs, []),
    }.items():
        with pytest.raises(ValueError, match=name):
            mlp(*given)


@pytest.mark.parametrize("sign", [1, -1])
def test_nan_passes_the_relu_whatever_its_sign(backend, sign):
    x = torch.tensor([[sign * torch.nan], [-torch.inf], [-0.0], [torch.inf]]).bfloat16()
    one = torch.ones(1, 1, dtype=torch.bfloat16)
    got = mlp([x], [one, one], backend=backend)[:, 0]
    assert got[0].isnan()
    assert got[1:].tolist() == [0, 0, torch.inf]
