"""Cases of the sparse Adam step: agreement of the backends, the first step in closed form.

The gradients of samples are short numbers, and so are their positions in cells, so that the sums of
a hash table's gradient are exact in any order.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from bench.case import U32, Bound, Cases, Given, Operation, Property, Random, on_backends
from bench.types import SomeTensors, TwoTensors
from methods.kernels.adam import BETAS, AdamState, hash_adam_, sparse_adam_
from methods.kernels.dispatch import served
from methods.kernels.encode import HashGrid, SampleGradients, encode, pack

STEPS = 3
RATE = 1e-2
LARGE = 1 << 20

DYADIC = {"levels": 2, "log2_table": 8, "n_min": 5, "n_max": 9}
"""A dense and a hashed level of 4 and 8 cells along an axis."""

SHARES = tuple(1 / (1 - beta) for beta in BETAS)
"""Rounding beta changes 1 - beta by at most this many u of itself, 10 and 100; and 1 - beta^n."""

FIRST, SECOND = (
    2 * U32 * (1 - beta**STEPS) * (share + 3 * STEPS)
    for beta, share in zip(BETAS, SHARES, strict=True)
)
OF_STEP = 1.2 * RATE * (2 * SHARES[0] + SHARES[1] + 16)

BOUNDS = {
    "table": Bound(
        "a step of at most 1.2 rates is off by the moments, the root of one of them, their "
        "corrections, and 16 u more: 1.2 rates (2 x 10 + 100 + 16) u; a sum of at most 1.04 by as "
        "many u; in 3 steps of two backends",
        2 * STEPS * (OF_STEP + 1.04) * U32,
    ),
    "first": Bound(
        "gradients of at most g by 1 - 0.9^3: 10 u of 1 - beta, 3 roundings a step, twice",
        lambda given: FIRST * given["most"],
    ),
    "second": Bound(
        "squares of at most g^2 by 1 - 0.99^3: 100 u of 1 - beta, 3 roundings a step, twice",
        lambda given: SECOND * given["most"] ** 2,
    ),
    "steps": Bound("counted: 0", 0.0),
}
PACKED = Bound(
    "of the backend's own table, it is one of the two nearest bfloat16: 2^-7 of a number",
    lambda given: (given["table"].abs() + 1.2 * STEPS * RATE) / 128,
)


def cases() -> Cases:
    """Tables in which none, some or all entries have a gradient; tiny and huge gradients."""
    dense = Operation("adam", served(__package__), _dense_steps, BOUNDS)
    bounds = {**BOUNDS, "packed": PACKED}
    hashed = Operation("hash adam", served(__package__), _hash_steps, bounds)
    first = Property(
        "adam",
        "the step is that of the closed form",
        "moments, corrections, root, quotient and sum: 16 u of rates of 1",
        on_backends(16, backends=served(__package__)),
    )
    found = [
        first.case(f"first gradient {gradient:g}", _first_step_error, gradient)
        for gradient in (0.0, 1e-40, 1e-30, 1e-15, 1.0, 1e15)
    ]
    for count, share in ((0, 0.5), (1, 1.0), (5000, 0.0), (5000, 0.3), (5000, 1.0), (LARGE, 0.3)):
        items = count if count == LARGE else 0
        found += dense.cases(f"{share:.0%} of {count:,}", _dense, count, share, 2, items=items)
    for features in (1, 3, 48):
        found += dense.cases(f"30% of 70, {features} features", _dense, 70, 0.3, features)
    for samples, features in ((0, 2), (1, 2), (60, 2), (60, 1), (60, 3)):
        name = f"{samples} samples, {features} features"
        found += hashed.cases(name, _hashed, samples, features)
    return found


def _dense(count: int, share: float, features: int) -> Given:
    random = Random(count)
    table = random.signed(count, features)
    grads = [
        random.signed(count, features) * (random.share(count, 1) < share) for _ in range(STEPS)
    ]
    return {"table": table, "grads": grads, "most": 1.0}


def _dense_steps(
    table: Tensor, grads: SomeTensors, most: float, backend: str
) -> tuple[Tensor, ...]:
    table, state = table.clone(), AdamState.like(table)
    for grad in grads:
        sparse_adam_(table, grad.clone(), state, RATE, backend=backend)
    return table, state.first, state.second, state.steps


def _hashed(samples: int, features: int) -> Given:
    grid = HashGrid(**DYADIC, features=features)
    random = Random(samples)
    table = random.signed(grid.entries, features)
    steps = []
    most = 0.0
    for _ in range(STEPS):
        positions = random.whole(0, 33, samples, 3) / 32
        grads = random.whole(-2, 3, samples, grid.channels) / 4
        steps.append((positions, grads))
        learned = table.clone().requires_grad_()
        encoded = encode(positions, learned, grid, backend="reference")
        (total,) = torch.autograd.grad(encoded, learned, grads.abs())
        most = max(most, total.max().item())
    return {"table": table, "steps": steps, "grid": grid, "most": most}


def _hash_steps(
    table: Tensor,
    steps: Sequence[TwoTensors],
    grid: HashGrid,
    most: float,
    backend: str,
) -> tuple[Tensor, ...]:
    """With two features, there is a packed copy; the result says by how much it is off."""
    table, state = table.clone(), AdamState.like(table)
    packed = pack(table) if table.shape[1] == 2 else None
    for positions, grads in steps:
        parts = SampleGradients(zip(positions.split(40), grads.split(40), strict=True))
        hash_adam_(table, parts, grid, state, RATE, packed=packed, backend=backend)
    off = table.new_zeros(0)
    if packed is not None:
        rounded, nearest = (x[:, None].view(torch.bfloat16).float() for x in (packed, pack(table)))
        off = rounded - nearest
    return table, state.first, state.second, state.steps, off


def _first_step_error(gradient: float, backend: str, device: str, precision: str) -> float:
    table = torch.zeros(3, 2, device=device)
    grad = torch.full_like(table, gradient)
    exact = grad[0, 0].item()  # rounded to float32
    sparse_adam_(table, grad, AdamState.like(table), 1.0, backend=backend)
    want = -exact / (abs(exact) + 1e-15)
    error = (table.double() - want).abs().max().item()
    return math.inf if math.isnan(error) else error
