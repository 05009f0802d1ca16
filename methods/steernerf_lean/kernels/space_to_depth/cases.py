"""Cases of the rows and pixels of cells.

Inputs of `space_to_depth` have few digits, and so have the weights of its base if s is a power of
2. Then nothing is rounded, whatever the order in which gradients of shared samples are summed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from bench.case import U32, Agreement, Case
from methods.kernels.dispatch import served
from methods.steernerf_lean.kernels.space_to_depth import (
    CellInputs,
    Layout,
    Pair,
    depth_to_space,
    space_to_depth,
)

STEPS = 16
"""Inputs are multiples of 1/16 from -1 to 1. With weights in multiples of 1/64, a product has 11
bits, and a sum of 2^13 products is exact."""

BASE = (
    "s a power of 2: short numbers, 0; else nine products, of weights that add up to 1 and numbers "
    "of at most 2, and two more numbers of at most 3"
)
BASE_GRADIENT = (
    "s a power of 2: short numbers, 0; else rounded weights, and a sample in the base of up to 9 "
    "cells of 9 pixels, each with a gradient of up to 1 + 2"
)


@dataclass(frozen=True)
class Size:
    """A picture of height x width cells, of which the share `share` is rendered."""

    height: int
    width: int
    layout: Layout
    share: float = 0.3
    preceding: int = 2
    multiple: int = 1

    @property
    def cells(self) -> Tensor:
        """The rendered cells."""
        generator = torch.Generator().manual_seed(1)
        shown = torch.rand(self.height * self.width, generator=generator) < self.share
        return shown.nonzero().squeeze(1)

    @property
    def rows(self) -> int:
        """Number of rows, including the padding."""
        return self.multiple * -(-len(self.cells) // self.multiple)


LEAN = Layout(6, 2, 4, True, True)
"""That of the lean renderer, but with L = 2, the harder case."""

SIZES = {
    "no cell": Size(3, 4, LEAN, share=0.0),
    "no cell, rows in eights": Size(3, 4, LEAN, share=0.0, multiple=8),
    "rows in eights": Size(20, 13, LEAN, multiple=8),
    "one cell": Size(1, 1, LEAN, share=1.0),
    "all cells": Size(5, 4, LEAN, share=1.0),
    "scattered": Size(20, 13, LEAN),
    "cold start": Size(9, 8, LEAN, preceding=0),
    "scale 2, one frame": Size(9, 8, Layout(3, 1, 2, True, True)),
    "scale 3": Size(9, 8, Layout(4, 1, 3, True, True)),
    "no surface": Size(9, 8, Layout(6, 2, 4, True, False)),
    "neither": Size(9, 8, Layout(6, 0, 4, False, False)),
    "a quarter of 200 x 200": Size(200, 200, LEAN, share=0.25),
}


def cases() -> list[Case]:
    """Sizes, layouts, a cold start; a frame, timed."""
    backends = served(__package__)
    rows = Agreement("space_to_depth", backends, BASE)
    rows_back = Agreement("space_to_depth backward", backends, BASE_GRADIENT)
    pixels = Agreement(
        "depth_to_space",
        backends,
        "ten terms of at most 4, and a logistic function, off by a few u, times 1: 328 u",
    )
    pixels_back = Agreement(
        "depth_to_space backward",
        backends,
        "an entry of the matrix has a sum over the p pixels of a cell, each term at most 1: "
        "2 (p^2 + 16) u",
    )
    found = []
    for name, size in SIZES.items():
        items = len(size.cells) if size.height == 200 else None
        rounded, p = size.layout.scale == 3, size.layout.scale**2
        found += [
            rows.case(name, partial(_rows, size), 2 * 32 * U32 * rounded, items=items),
            rows_back.case(
                name, partial(_rows_back, size), 2 * 81 * 81 * 3 * U32 * rounded, items=items
            ),
            pixels.case(name, partial(_pixels, size), 2 * (10 * 16 + 4) * U32, items=items),
            pixels_back.case(
                name, partial(_pixels_back, size), 2 * (p * p + 16) * U32, items=items
            ),
        ]
    return found


def _short(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randint(-STEPS, STEPS + 1, shape, generator=generator) / STEPS


def _inputs(size: Size, device: str) -> tuple[CellInputs, list[Tensor]]:
    """Inputs of `space_to_depth`, and the list of those in which it is differentiable."""
    layout, generator = size.layout, torch.Generator().manual_seed(2)
    cells, pixels = size.cells, layout.scale**2

    def short(*shape: int) -> Tensor:
        return _short(generator, *shape).to(device)

    def index(points: int, *shape: int) -> Tensor:
        entries = torch.randint(-1, points, shape, generator=generator, dtype=torch.int32)
        return entries.to(device)

    values = short(size.height, size.width, layout.channels).requires_grad_()
    alpha = short(size.height, size.width).requires_grad_()
    full = size.height * layout.scale, size.width * layout.scale
    preceding = [
        (short(30, layout.channels).requires_grad_(), index(30, *full))
        for _ in range(min(size.preceding, layout.frames))
    ]
    history: Pair | None = None
    surface: Pair | None = None
    if layout.history and size.preceding:
        valid = torch.randint(0, 2, (len(cells), pixels), generator=generator).float()
        history = short(len(cells), pixels, 3), valid.to(device)
    learned = [values, alpha, *(points for points, _ in preceding)]
    if layout.surface:
        surface = short(50, layout.channels + 1).requires_grad_(), index(50, len(cells), pixels)
        learned.append(surface[0])
    background = short(layout.channels)
    inputs = CellInputs(values, alpha, background, cells.to(device), preceding, history, surface)
    return inputs, learned


def _rows(size: Size, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    inputs, _ = _inputs(size, device)
    layout, multiple = size.layout, size.multiple

    def call(backend: str) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return space_to_depth(inputs, layout, multiple=multiple, backend=backend)

    return call


def _rows_back(size: Size, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    inputs, learned = _inputs(size, device)
    generator, layout = torch.Generator().manual_seed(3), size.layout
    grads = (
        _short(generator, len(size.cells), layout.scale**2, 3).to(device),
        _short(generator, size.rows, layout.width).to(device),
    )

    def call(backend: str) -> tuple[Tensor, ...]:
        found = space_to_depth(inputs, layout, multiple=size.multiple, backend=backend)
        return torch.autograd.grad(found, learned, grads)

    return call


def _outputs(size: Size, device: str) -> list[Tensor]:
    """Base, rows, output and, if there is one, matrix."""
    layout, generator = size.layout, torch.Generator().manual_seed(4)
    short, pixels = partial(_short, generator), size.layout.scale**2
    parts = [
        short(len(size.cells), pixels, 3),
        short(size.rows, layout.width),
        4 * short(size.rows, pixels * (3 + layout.history)),
    ]
    if layout.surface:
        parts.append(short(size.rows, 3 * (layout.channels + 1)))
    return [part.to(device).requires_grad_() for part in parts]


def _pixels(size: Size, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    parts = _outputs(size, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        with torch.no_grad():
            return (_drawn(parts, size.layout, backend),)

    return call


def _pixels_back(size: Size, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    parts = _outputs(size, device)
    grad = _short(torch.Generator().manual_seed(5), *parts[0].shape).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels = _drawn(parts, size.layout, backend)
        return torch.autograd.grad(pixels, parts, grad, materialize_grads=True)

    return call


def _drawn(parts: list[Tensor], layout: Layout, backend: str) -> Tensor:
    base, rows, output, *matrix = parts
    return depth_to_space(
        base, rows, output, matrix[0] if matrix else None, layout, backend=backend
    )
