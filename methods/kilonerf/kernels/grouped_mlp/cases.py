"""Cases of the small networks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import U32, Agreement, Case
from methods.kernels.dispatch import served
from methods.kilonerf.kernels.grouped_mlp import (
    HIDDEN,
    Networks,
    colours,
    densities,
    encode_frequencies,
    grouped_linear,
    locate,
    order,
)

SIZES = {"in": (63, 32), "mid": (32, 32), "density": (32, 1)} | {
    "feature": (32, 32),
    "direction": (59, 32),
    "colour": (32, 3),
}
BOUND = 1 / 8
"""Largest weight and bias in the cases, so that no sum exceeds 8 in any layer."""

KINDS = {
    "some samples without a network": (1000, 7),
    "no sample": (0, 3),
    "one sample": (1, 1),
    "fewer samples than go together": (5, 1),
    "most networks empty": (40, 300),
}
"""Numbers of samples and networks."""

MANY = 1_200_000, 2000


def cases() -> list[Case]:
    """Sorting, encoding, single layers forward and backward, and whole networks."""
    return [*_places(), *_sorting(), *_encoding(), *_layers(), *_networks()]


def _numbers(count: int, networks: int) -> Tensor:
    """A network, or -1 for none, for each sample."""
    generator = torch.Generator().manual_seed(count)
    return torch.randint(-1, networks, (count,), generator=generator)


def _uniform(seed: int, *shape: int) -> Tensor:
    """Numbers from -1 to 1."""
    return 2 * torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) - 1


def _places() -> list[Case]:
    kernel = Agreement(
        "locate",
        served(__package__),
        "a quotient below 5 is rounded alike: the same network, and 8 u where it is rounded once "
        "more",
    )

    def prepare(count: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
        positions = 0.5 + 0.6 * _uniform(count, count, 3).to(device)  # some beyond the grid
        positions[: count // 9] = torch.nan
        cubes = torch.arange(60, dtype=torch.int16, device=device).view(3, 4, 5) - 20
        corner = torch.tensor((0.1, 0.2, 0.0), device=device)
        side = torch.tensor(0.2, device=device)

        def call(backend: str) -> tuple[Tensor, ...]:
            networks, local = locate(positions, cubes.clamp(min=-1), corner, side, backend=backend)
            return networks, local

        return call

    return [
        kernel.case(f"{count:,} positions", partial(prepare, count), 8 * U32, items=items)
        for count, items in ((0, None), (1, None), (1000, None), (1 << 18, 1 << 18))
    ]


def _sorting() -> list[Case]:
    exact = Agreement("order", served(__package__), "whole numbers: 0")

    def prepare(count: int, networks: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
        numbers = _numbers(count, networks).to(device)

        def call(backend: str) -> tuple[Tensor, ...]:
            groups = order(numbers, networks, backend=backend)
            return groups.permutation, groups.offsets

        return call

    found = [exact.case(name, partial(prepare, *size), 0.0) for name, size in KINDS.items()]
    return [*found, exact.case("1.2 million", partial(prepare, *MANY), 0.0, items=MANY[0])]


def _encoding() -> list[Case]:
    kernel = Agreement(
        "encode frequencies",
        served(__package__),
        "an angle of at most 512 is rounded by none, reduced with an error below 4 u, and its sine "
        "within 4 u; each of 4 doublings doubles the error and adds 4 u: 16 x 8 u + 60 u",
    )

    def prepare(count: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
        inputs = _uniform(count, count, 3).to(device)
        return lambda backend: (encode_frequencies(inputs, 10, backend=backend),)

    sizes = ((0, None), (1, None), (1000, None), (1 << 18, 1 << 18))
    return [
        kernel.case(f"{count:,} samples", partial(prepare, count), 188 * U32, items=items)
        for count, items in sizes
    ]


def _layers() -> list[Case]:
    forward = Agreement(
        "grouped linear",
        served(__package__),
        "sums of at most 64 products below 1/8, 65 roundings of numbers below 8, twice: 1040 u",
    )
    backward = Agreement(
        "grouped linear backward",
        served(__package__),
        "sums of at most 1000 products below 1, as many roundings of numbers below 1000, in the "
        "worst case: 2 x 10^6 u; most are of few samples",
    )
    found = []
    for name, size in KINDS.items():
        for shape in ((63, 32), (32, 1), (5, 50)):
            text = f"{name}, {shape[0]} to {shape[1]}"
            relu = shape[1] > 3
            found += [
                forward.case(text, partial(_forward, *size, *shape, relu), 1040 * U32),
                backward.case(text, partial(_backward, *size, *shape, relu), 2e6 * U32),
            ]
    large = MANY[0] // 8, MANY[1] // 8
    for text, shape in (("150 thousand", (63, 32)),):
        found += [
            forward.case(text, partial(_forward, *large, *shape, True), 1040 * U32, items=large[0]),
            backward.case(
                text, partial(_backward, *large, *shape, True), 2e6 * U32, items=large[0]
            ),
        ]
    return found


def _given(
    count: int, networks: int, inputs: int, outputs: int, device: str
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    offsets = order(_numbers(count, networks), networks, backend="reference").offsets
    x = _uniform(1, int(offsets[-1]), inputs)
    weights = BOUND * _uniform(2, networks, inputs, outputs)
    biases = BOUND * _uniform(3, networks, outputs)
    return x.to(device), weights.to(device), biases.to(device), offsets.to(device)


def _forward(
    count: int, networks: int, inputs: int, outputs: int, relu: bool, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    given = _given(count, networks, inputs, outputs, device)
    return lambda backend: (grouped_linear(*given, relu=relu, backend=backend),)


def _backward(
    count: int, networks: int, inputs: int, outputs: int, relu: bool, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    *tensors, offsets = _given(count, networks, inputs, outputs, device)
    if relu:  # keeps sums away from 0, where rounding would decide
        tensors[2] = tensors[2].sign() * 16
    tensors = [tensor.requires_grad_() for tensor in tensors]
    grad = _uniform(4, len(tensors[0]), outputs).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        x, weights, biases = tensors
        out = grouped_linear(x, weights, biases, offsets, relu=relu, backend=backend)
        return torch.autograd.grad(out, tensors, grad)

    return call


def _networks() -> list[Case]:
    density = Agreement(
        "densities of networks",
        served(__package__),
        "inputs off by 188 u, three layers that multiply an error by at most 63/8, 4 and 4 and add "
        "1040 u each, in the worst case: 3 x 10^4 + 2 x 10^4 u",
    )
    colour = Agreement(
        "colours of networks",
        served(__package__),
        "three layers that multiply an error by at most 4, 59/8 and 4 and add 1040 u each: "
        "4 x 10^4 u, a sigmoid divides it by 4",
    )
    found = []
    for name, size in (KINDS | {"1.2 million in 2,000": MANY}).items():
        items = size[0] if size == MANY else None
        found += [
            density.case(name, partial(_densities, *size), 5e4 * U32, items=items),
            colour.case(name, partial(_colours, *size), 1e4 * U32, items=items),
        ]
    return found


def _few(networks: int, device: str) -> Networks:
    weights, biases = {}, {}
    for n, (name, (inputs, outputs)) in enumerate(SIZES.items()):
        weights[name] = BOUND * _uniform(10 + n, networks, inputs, outputs).to(device)
        biases[name] = BOUND * _uniform(20 + n, networks, outputs).to(device)
    return Networks(weights, biases)


def _densities(count: int, networks: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    few, numbers = _few(networks, device), _numbers(count, networks).to(device)
    positions = _uniform(5, count, 3).to(device)
    return lambda backend: densities(positions, numbers, few, backend=backend)


def _colours(count: int, networks: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    few, numbers = _few(networks, device), _numbers(count, networks)
    geometry = torch.cat((_uniform(6, count, HIDDEN), numbers[:, None].float()), dim=1).to(device)
    encoded = _uniform(7, count, SIZES["direction"][0] - HIDDEN).to(device)
    return lambda backend: (colours(geometry, encoded, few, backend=backend),)
