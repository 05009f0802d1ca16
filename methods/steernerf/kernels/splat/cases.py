"""Cases of the splatting: agreement of the backends, also at borders and far outside."""

import math
from functools import partial

import torch
from torch import Tensor

from bench.cameras import pixel_grid
from bench.case import Bound, Case, Given, Operation
from methods.kernels.dispatch import served
from methods.steernerf.kernels.splat import splat

LOW, HIGH = 200, 800  # sides in pixels of the splatted frame and of the target picture
FRAME = f"{LOW} x {LOW} into {HIGH} x {HIGH}"

WRONG = (math.nan, math.inf, -math.inf, 1e20, -1e20, 0.0, -0.0, 1e-20, -1e-20)
"""Coordinates and depths that are outside every picture, or barely inside."""


def _shown(given: Given, backend: str) -> tuple[Tensor, ...]:
    return (splat(given["pixels"], given["depth"], *given["size"], backend=backend),)


EXACT = Bound("decided by comparisons, nothing is computed: 0", 0.0)
SPLAT = Operation("splat", served(__package__), _shown, {"pixels": EXACT})


def cases() -> list[Case]:
    """Splatting by all backends; a frame seen from beside is timed."""
    found = SPLAT.cases("at borders, outside or not finite", _extreme)
    for count, width, height in ((0, 5, 4), (50, 1, 1), (3000, 13, 7), (5000, 4097, 3)):
        name = f"{count} points in {width} x {height}"
        found += SPLAT.cases(name, partial(_points, count, width, height))
    return found + SPLAT.cases(FRAME, _seen_aside, items=LOW**2)


def _points(count: int, width: int, height: int) -> Given:
    generator = torch.Generator().manual_seed(count + width)
    pixels = torch.rand(count, 2, generator=generator) * torch.tensor([width, height])
    depth = torch.rand(count, generator=generator)
    return {"pixels": pixels, "depth": depth, "size": (width, height)}


def _extreme() -> Given:
    """Points on each border of a picture, just before and after it, and far away."""
    width, height = 7, 5
    edges = torch.tensor([0.0, 1.0, width - 1.0, width, height - 1.0, height])
    around = [edges.nextafter(torch.tensor(end)) for end in (-math.inf, math.inf)]
    places = torch.cat((edges, *around, torch.tensor(WRONG)))
    points = torch.cartesian_prod(places, places, torch.tensor((*WRONG, 1.0)))
    points = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(0))]
    return {"pixels": points[:, :2], "depth": points[:, 2], "size": (width, height)}


def _seen_aside() -> Given:
    """A frame seen from slightly beside: its pixels scatter by half a pixel of the picture."""
    generator = torch.Generator().manual_seed(0)
    pixels = HIGH / LOW * pixel_grid(LOW, LOW) + torch.tensor([5.0, -3.0])
    pixels += 0.5 * torch.randn(LOW**2, 2, generator=generator)
    return {"pixels": pixels, "depth": torch.ones(LOW**2), "size": (HIGH, HIGH)}
