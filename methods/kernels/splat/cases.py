"""Cases of the splatting. Which point is shown is decided by comparisons alone: tolerance 0."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.cameras import pixel_grid
from methods.kernels.case import U32, Case, Prepared
from methods.kernels.splat import Rule, gather, splat

LOW, HIGH = 200, 800
"""Side of the frame that is splatted and of the picture it lands in, in pixels."""

CHANNELS = 6
"""Features of a point in SteerNeRF: a colour and three more."""

WRONG = (math.nan, math.inf, -math.inf, 1e20, -1e20, 0.0, -0.0, 1e-20, -1e-20)
"""Values that no picture has room for, or only just."""


def cases() -> list[Case]:
    """No, one, many and crowded points; ties; points outside; thin pictures; a frame, timed."""
    sizes: list[tuple[str, int, int, int, dict]] = [
        ("no point", 0, 5, 4, {}),
        ("one pixel", 50, 1, 1, {}),
        ("sparse", 100, 67, 45, {}),
        ("crowded", 3000, 13, 7, {}),
        ("ties", 3000, 13, 7, {"tied": True}),
        ("outside or not finite", 1000, 40, 30, {"spoiled": True}),
        ("one wide row", 5000, 4097, 1, {}),
        ("three wide rows", 5000, 4097, 3, {}),
    ]
    index_kinds: list[tuple[str, int, int, int]] = [
        ("no point", 0, 20, CHANNELS),
        ("no pixel", 10, 0, CHANNELS),
        ("no channel", 10, 20, 0),
        ("one channel", 300, 1001, 1),
        ("few places for each point", 1000, 1001, CHANNELS),
        ("many places for each point", 3, 1001, CHANNELS),
    ]
    rules: tuple[tuple[str, Rule], ...] = (("splat", "nearest"), ("splat last", "last"))
    directions = (("splat gather", _gather), ("splat gather backward", _gather_backward))
    frame = f"{LOW} x {LOW} into {HIGH} x {HIGH}"
    found = []
    for kernel, rule in rules:
        for name, count, width, height, options in sizes:
            points = partial(_points, count, width, height, **options)
            prepare = partial(_splat, points, width, height, rule)
            found.append(Case(kernel, name, "fp32", count, prepare))
        timed = partial(_splat, _frame, HIGH, HIGH, rule)
        found.append(Case(kernel, frame, "fp32", LOW**2, timed, timed=True))
    for kernel, make in directions:
        for name, count, pixels, channels in index_kinds:
            prepare = partial(make, partial(_index, count, pixels), count, channels)
            found.append(Case(kernel, name, "fp32", pixels, prepare))
        timed = partial(make, _frame_index, LOW**2, CHANNELS)
        found.append(Case(kernel, frame, "fp32", HIGH**2, timed, timed=True))
    return found


def _points(
    count: int, width: int, height: int, *, tied: bool = False, spoiled: bool = False
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count + width)
    pixels = torch.rand(count, 2, generator=generator) * torch.tensor([width, height])
    depth = 1 + torch.rand(count, generator=generator)
    if tied:  # by depth, by u and v, and exact duplicates
        pixels, depth = (4 * pixels).round() / 4, depth.round()
    if spoiled:
        pixels = 1.5 * pixels - 0.25 * torch.tensor([width, height])
        for values in (pixels, depth):
            drawn = torch.randint(len(WRONG), values.shape, generator=generator)
            spoil = torch.rand(values.shape, generator=generator) < 0.1
            values[spoil] = torch.tensor(WRONG)[drawn][spoil]
    return pixels, depth


def _frame() -> tuple[Tensor, Tensor]:
    """A frame seen from a little aside: its pixels scattered by half a pixel of the picture."""
    generator = torch.Generator().manual_seed(0)
    pixels = HIGH / LOW * pixel_grid(LOW, LOW) + torch.tensor([5.0, -3.0])
    pixels += 0.5 * torch.randn(LOW**2, 2, generator=generator)
    return pixels, 1 + torch.rand(LOW**2, generator=generator)


def _index(points: int, pixels: int) -> Tensor:
    generator = torch.Generator().manual_seed(points + pixels)
    return torch.randint(-1, points, (pixels,), generator=generator, dtype=torch.int32)


def _frame_index() -> Tensor:
    return splat(*_frame(), HIGH, HIGH, backend="reference")


def _splat(
    points: Callable[[], tuple[Tensor, Tensor]], width: int, height: int, rule: Rule, device: str
) -> Prepared:
    pixels, depth = (tensor.to(device) for tensor in points())

    def call(backend: str) -> tuple[Tensor, ...]:
        return (splat(pixels, depth, width, height, rule=rule, backend=backend),)

    return Prepared(call, 0.0)


def _rows(points: int, channels: int, device: str) -> Tensor:
    generator = torch.Generator().manual_seed(points)
    return torch.rand(points, channels, generator=generator).to(device)


def _gather(make_index: Callable[[], Tensor], points: int, channels: int, device: str) -> Prepared:
    index, values = make_index().to(device), _rows(points, channels, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        return (gather(values, index, backend=backend),)

    return Prepared(call, 0.0)


def _gather_backward(
    make_index: Callable[[], Tensor], points: int, channels: int, device: str
) -> Prepared:
    index, values = make_index().to(device), _rows(points, channels, device).requires_grad_()
    grad = torch.rand(*index.shape, channels, generator=torch.Generator().manual_seed(1)).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        return torch.autograd.grad(gather(values, index, backend=backend), values, grad)

    # The gradient of a point at n places is a sum of n terms below 1, made in either backend by
    # n - 1 additions whose results are at most n, each off by n u. A single term is exact.
    places = int(torch.bincount(index[index >= 0], minlength=1).max())
    return Prepared(call, 2 * max(places - 1, 0) * places * U32)
