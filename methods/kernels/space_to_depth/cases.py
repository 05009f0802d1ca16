"""Cases of what a network on cells is told and draws.

Inputs of `lift` are few digits long, and so are the weights of its base where s is a power of 2:
nothing is rounded there, in whatever order the gradients of shared samples are added up.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from methods.kernels.case import U32, Case, Prepared
from methods.kernels.space_to_depth import Layout, Told, draw, lift

STEPS = 16
"""Numbers are multiples of 1/16 from -1 to 1. With weights in multiples of 1/64 a product has 11
bits, and a sum of 2^13 of them is exact."""

ROUNDED_BASE = 2 * 32 * U32
"""Where s is no power of 2: both backends add nine products, of weights that add up to 1 and
numbers of at most 2, and take two more numbers of at most 3 away."""


@dataclass(frozen=True)
class Size:
    """A picture of height x width cells, `share` of them drawn."""

    height: int
    width: int
    layout: Layout
    share: float = 0.3
    preceding: int = 2
    phase: tuple[float, float] = (0.0, 0.0)
    multiple: int = 1


LEAN = Layout(6, 2, 4, True, True)

SIZES = {
    "no cell": Size(3, 4, LEAN, share=0.0),
    "no cell, rows in eights": Size(3, 4, LEAN, share=0.0, multiple=8),
    "rows in eights": Size(20, 13, LEAN, multiple=8),
    "one cell": Size(1, 1, LEAN, share=1.0),
    "all cells": Size(5, 4, LEAN, share=1.0),
    "scattered": Size(20, 13, LEAN),
    "cold start": Size(9, 8, LEAN, preceding=0),
    "another phase": Size(9, 8, LEAN, phase=(1.5, -0.5)),
    "scale 2, one frame": Size(9, 8, Layout(3, 1, 2, True, True)),
    "scale 3": Size(9, 8, Layout(4, 1, 3, True, True)),
    "no surface": Size(9, 8, Layout(6, 2, 4, True, False)),
    "neither": Size(9, 8, Layout(6, 0, 4, False, False)),
}

FRAME = "a quarter of 200 x 200"


def cases() -> list[Case]:
    """Sizes, layouts, a cold start; a frame, timed."""
    found = []
    for kernel, make in (
        ("lift", _lift),
        ("lift backward", _lift_backward),
        ("lift draw", _draw),
        ("lift draw backward", _draw_backward),
    ):
        for name, size in SIZES.items():
            count = int(_cells(size).shape[0])
            found.append(Case(kernel, name, "fp32", count, partial(make, size)))
        frame = Size(200, 200, LEAN, share=0.25)
        timed = partial(make, frame)
        found.append(Case(kernel, FRAME, "fp32", len(_cells(frame)), timed, timed=True))
    return found


def _short(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randint(-STEPS, STEPS + 1, shape, generator=generator) / STEPS


def _cells(size: Size) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    shown = torch.rand(size.height * size.width, generator=generator) < size.share
    return shown.nonzero().squeeze(1)


def _rows(size: Size) -> int:
    return size.multiple * -(-len(_cells(size)) // size.multiple)


def _told(size: Size, device: str) -> tuple[dict[str, Any], list[Tensor]]:
    """Arguments of `lift`, and those of them that it is differentiable in."""
    layout, generator = size.layout, torch.Generator().manual_seed(2)
    short = partial(_short, generator)
    cells, pixels = _cells(size), layout.scale**2
    full = size.height * layout.scale, size.width * layout.scale
    values = short(size.height, size.width, layout.channels).to(device).requires_grad_()
    alpha = short(size.height, size.width).to(device).requires_grad_()
    learned, preceding = [values, alpha], []
    history: Told | None = None
    surface: Told | None = None
    for _ in range(min(size.preceding, layout.frames)):
        points = short(30, layout.channels).to(device).requires_grad_()
        index = torch.randint(-1, 30, full, generator=generator, dtype=torch.int32)
        preceding.append((points, index.to(device)))
        learned.append(points)
    if layout.history and size.preceding:
        valid = torch.randint(0, 2, (len(cells), pixels), generator=generator).float()
        history = short(len(cells), pixels, 3).to(device), valid.to(device)
    if layout.surface:
        points = short(50, layout.channels + 1).to(device).requires_grad_()
        index = torch.randint(-1, 50, (len(cells), pixels), generator=generator, dtype=torch.int32)
        surface = points, index.to(device)
        learned.append(points)
    arguments = {
        "values": values,
        "alpha": alpha,
        "background": short(layout.channels).to(device),
        "cells": cells.to(device),
        "preceding": preceding,
        "history": history,
        "surface": surface,
        "layout": layout,
        "phase": size.phase,
        "multiple": size.multiple,
    }
    return arguments, learned


def _lift(size: Size, device: str) -> Prepared:
    arguments, _ = _told(size, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return lift(**arguments, backend=backend)

    return Prepared(call, 0.0 if size.layout.scale in (2, 4) else ROUNDED_BASE)


def _lift_backward(size: Size, device: str) -> Prepared:
    arguments, learned = _told(size, device)
    generator = torch.Generator().manual_seed(3)
    count, pixels = len(arguments["cells"]), size.layout.scale**2
    grads = (
        _short(generator, count, pixels, 3).to(device),
        _short(generator, _rows(size), size.layout.width).to(device),
    )

    def call(backend: str) -> tuple[Tensor, ...]:
        return torch.autograd.grad(lift(**arguments, backend=backend), learned, grads)

    # Weights of s = 3 are rounded, and their products; a sample is in the base of up to 9 cells of
    # 9 pixels, each with a gradient of up to 1 + 2.
    return Prepared(call, 0.0 if size.layout.scale in (2, 4) else 2 * 81 * 81 * 3 * U32)


def _answered(size: Size, device: str) -> tuple[list[Tensor], Layout]:
    layout, generator = size.layout, torch.Generator().manual_seed(4)
    short, count, pixels = partial(_short, generator), len(_cells(size)), size.layout.scale**2
    rows = _rows(size)
    parts = [
        short(count, pixels, 3),
        short(rows, layout.width),
        4 * short(rows, pixels * (3 + layout.history)),
    ]
    if layout.surface:
        parts.append(short(rows, 3 * (layout.channels + 1)))
    return [part.to(device).requires_grad_() for part in parts], layout


def _draw(size: Size, device: str) -> Prepared:
    parts, layout = _answered(size, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return (_drawn(parts, layout, backend),)

    # Ten terms of at most 4, and a logistic function, off by no more than a few u, times 1.
    return Prepared(call, 2 * (10 * 16 + 4) * U32)


def _draw_backward(size: Size, device: str) -> Prepared:
    parts, layout = _answered(size, device)
    grad = _short(torch.Generator().manual_seed(5), *parts[0].shape).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels = _drawn(parts, layout, backend)
        return torch.autograd.grad(pixels, parts, grad, materialize_grads=True)

    # An entry of the matrix has a sum over the pixels of a cell, each term at most 1.
    pixels = layout.scale**2
    return Prepared(call, 2 * (pixels * pixels + 16) * U32)


def _drawn(parts: list[Tensor], layout: Layout, backend: str) -> Tensor:
    base, rows, answer, *matrix = parts
    return draw(base, rows, answer, matrix[0] if matrix else None, layout, backend=backend)
