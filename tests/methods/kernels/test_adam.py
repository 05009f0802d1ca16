"""The sparse Adam step against torch's dense one, and what it leaves alone."""

import pytest
import torch

from methods.kernels.adam import AdamState, hash_adam_, sparse_adam_
from methods.kernels.encode import HashGrid, SampleGradients, encode, pack
from tests.common import refusal, seeded


def test_an_entry_makes_the_steps_of_adam_at_which_it_has_a_gradient(backend):
    """As if it were alone, whatever the others do; torch leaves out what has no gradient."""
    generator = seeded(0)
    table = torch.randn(50, 2, generator=generator)
    entries = [torch.nn.Parameter(entry.clone()) for entry in table]
    optimiser = torch.optim.Adam(entries, lr=1e-2, betas=(0.9, 0.99), eps=1e-15)
    state = AdamState.like(table)
    for step in range(20):
        grad = torch.randn(50, 2, generator=generator)
        grad[torch.rand(50, generator=generator) >= 0.5] = 0
        grad[:5, 1] *= step % 2  # where it is 0, the moments of the feature go on
        for entry, own in zip(entries, grad, strict=True):
            entry.grad = own.clone() if own.any() else None
        optimiser.step()
        sparse_adam_(table, grad, state, 1e-2, backend=backend)
        assert not grad.any()  # it is cleared
    # 20 steps of at most 1e-2 each, a few roundings of relative size 6e-8 in each.
    torch.testing.assert_close(table, torch.stack(entries).detach(), rtol=1e-6, atol=1e-6)
    assert state.steps.tolist() == [int(optimiser.state[x]["step"]) for x in entries]


@pytest.mark.parametrize("features", [1, 2, 3])
def test_the_step_of_collected_gradients_is_that_of_their_sum(backend, features):
    """To the bit, as both add up in the order of the samples; over parts, levels and steps."""
    grid = HashGrid(levels=3, features=features, log2_table=12, n_min=4, n_max=64)
    generator = seeded(0)
    start = torch.randn(grid.entries, features, generator=generator)
    tables, states = (start.clone(), start), (AdamState.like(start), AdamState.like(start))
    words = pack(start) if features == 2 else None
    for count in (300, 0, 1000):
        positions = torch.rand(count, 3, generator=generator)
        grad = torch.randn(count, grid.channels, generator=generator)
        gradients = SampleGradients(zip(positions.split(400), grad.split(400), strict=True))
        for _ in range(2):  # the second one has no gradients to step by
            hash_adam_(tables[0], gradients, grid, states[0], 0.1, packed=words, backend=backend)
            assert not gradients
        asking = tables[1].clone().requires_grad_()
        encoded = encode(positions, asking, grid, backend=backend)
        (total,) = torch.autograd.grad(encoded, asking, grad)
        sparse_adam_(tables[1], total, states[1], 0.1, backend=backend)
    assert torch.equal(*tables)
    for moments in zip(*(state.tensors().values() for state in states), strict=True):
        assert torch.equal(*moments)
    assert words is None or torch.equal(words, pack(tables[0]))


def test_wrong_arguments_are_named():
    grid = HashGrid(levels=1, features=2, log2_table=6, n_min=4, n_max=4)
    gradients = SampleGradients([(torch.zeros(5, 3), torch.zeros(5, 3))])
    table = torch.zeros(grid.entries, 2)
    with refusal("steps: expected shape", ValueError):
        sparse_adam_(table, table.clone(), AdamState(table, table, torch.zeros(2)), 0.1)
    with refusal(r"gradients: expected shape \[5, 2\], got \[5, 3\]", ValueError):
        hash_adam_(table, gradients, grid, AdamState.like(table), 0.1)
    with refusal("packed: expected shape", ValueError):
        hash_adam_(table, gradients, grid, AdamState.like(table), 0.1, packed=torch.zeros(2))
