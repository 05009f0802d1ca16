"""Renders exact pictures of analytic models: every sub-pixel ray is solved in closed form.

A picture is rendered in bands of rows. In each band, a part of a model is traced only in the
columns that its bounding box can cover.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from bench.cameras import project
from bench.errors import unexpected
from bench.types import EMPTY_ALPHA, Camera, Frame

BAND_RAYS = 1 << 18
"""Rays per band: enough to hide the cost of calls, few enough to stay in the cache."""

Span = tuple[int, int, int]
"""A part's number, the first column that it can cover in a band, and one past the last."""


@dataclass(frozen=True)
class Band:
    """The rays of some rows of a picture, [rows, W, S], all from `origin` [3].

    The direction at image-plane coordinates x [1, W, S], y [rows, 1, S] is `rotation` @ (x, y, 1).
    """

    origin: Tensor
    rotation: Tensor
    x: Tensor
    y: Tensor

    def directions(self, frame: Tensor, columns: slice) -> tuple[Tensor, Tensor, Tensor]:
        """Directions of the rays in `columns`, as components along the axes of `frame` [3, 3]."""
        matrix = (frame.T @ self.rotation).tolist()
        x = self.x[:, columns]
        across, down, ahead = ([row[i] for row in matrix] for i in range(3))
        u, v, w = ((x * across[i] + ahead[i]) + self.y * down[i] for i in range(3))
        return u, v, w


@dataclass(frozen=True)
class Traced:
    """What rays [rows, W, S] see: `rgb` (premultiplied), `alpha`, `depth` (premultiplied)."""

    rgb: Tensor
    alpha: Tensor
    depth: Tensor


class Model(Protocol):
    """A model made of parts, through which a band of rays can be traced."""

    def boxes(self) -> Tensor:
        """Corners of a box around each part, [P, 8, 3]."""

    def trace(self, band: Band, spans: Sequence[Span]) -> Traced:
        """What the rays see of the parts in `spans`; a part is never seen outside its span."""


def render(model: Model, camera: Camera, background: Tensor, samples: int) -> Frame:
    """Render `model`, averaged over `samples` rays per pixel (a power of two).

    `camera` is in the model's units; rays that hit nothing show `background` [3]. A pixel's alpha
    and rgb are means over its rays, depth the mean z-depth weighted by opacity (+inf where alpha is
    below EMPTY_ALPHA). A single sample is at the centre.
    """
    device, width, height = camera.c2w.device, camera.width, camera.height
    offsets = sample_offsets(samples).to(device)
    x = (torch.arange(width, device=device)[:, None] + offsets[:, 0] - camera.cx) / camera.fx
    y = (torch.arange(height, device=device)[:, None] + offsets[:, 1] - camera.cy) / camera.fy
    rgb = torch.zeros(height, width, 3, device=device)
    alpha, depth = torch.zeros(2, height, width, device=device)
    rows = max(BAND_RAYS // (width * samples), 1)
    boxes = ProjectedBoxes(camera, model.boxes().to(device))
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        spans = boxes.spans(top, bottom)
        if not spans:
            continue
        first, last = min(span[1] for span in spans), max(span[2] for span in spans)
        band = Band(camera.c2w[:, 3], camera.c2w[:, :3], x[None, first:last], y[top:bottom, None])
        traced = model.trace(band, [(part, a - first, b - first) for part, a, b in spans])
        rgb[top:bottom, first:last] = traced.rgb.mean(2)
        alpha[top:bottom, first:last] = traced.alpha.mean(2)
        depth[top:bottom, first:last] = traced.depth.mean(2)
    empty = alpha < EMPTY_ALPHA
    depth = (depth / alpha.clamp(min=EMPTY_ALPHA)).masked_fill(empty, math.inf)
    return Frame(rgb + (1 - alpha)[..., None] * background.to(device), depth, alpha)


def sample_offsets(samples: int) -> Tensor:
    """Hammersley points [samples, 2] in a pixel, one in each of `samples` rows and columns."""
    if samples < 1 or samples & (samples - 1):
        raise unexpected("samples", "a power of two", samples)
    bits = samples.bit_length() - 1
    index, mirrored = torch.arange(samples), torch.zeros(samples, dtype=torch.int64)
    for bit in range(bits):
        mirrored |= ((index >> bit) & 1) << (bits - 1 - bit)
    return (torch.stack((index, mirrored), dim=1) + 0.5) / samples


class ProjectedBoxes:
    """The bounding boxes of a model's parts as a camera sees them."""

    def __init__(self, camera: Camera, boxes: Tensor) -> None:
        pixels, depth = project(camera, boxes.reshape(-1, 3))
        self.width = camera.width
        self.in_front = (depth.reshape(-1, 8) > 0).all(1)
        self.behind = (depth.reshape(-1, 8) <= 0).all(1)
        pairs = torch.combinations(torch.arange(8, device=boxes.device))
        # The outline of a convex box lies in the hull of the segments between pairs of corners.
        corners = pixels.reshape(-1, 8, 2)
        self.start, self.end = corners[:, pairs[:, 0]], corners[:, pairs[:, 1]]  # [P, 28, 2]

    def spans(self, top: int, bottom: int) -> list[Span]:
        """The parts that may be visible in rows top <= row < bottom, each with its columns.

        A part that reaches behind the camera may be visible anywhere; one behind it is not visible.
        """
        (u0, v0), (u1, v1) = self.start.unbind(-1), self.end.unbind(-1)
        flat = v0 == v1
        rise = (v1 - v0).masked_fill(flat, 1)
        # The range of each segment between the rows, with one pixel of margin for rounding.
        low = ((top - 1 - v0) / rise).clamp(0, 1).masked_fill(flat, 0)
        high = ((bottom + 1 - v0) / rise).clamp(0, 1).masked_fill(flat, 1)
        meets = (torch.minimum(v0, v1) <= bottom + 1) & (torch.maximum(v0, v1) >= top - 1)
        ends = torch.stack((u0 + low * (u1 - u0), u0 + high * (u1 - u0)))
        first = ends.masked_fill(~meets, math.inf).amin((0, 2)).floor() - 1
        last = ends.masked_fill(~meets, -math.inf).amax((0, 2)).ceil() + 1
        first = first.masked_fill(~self.in_front, 0).clamp(min=0)
        last = last.masked_fill(~self.in_front, self.width).clamp(max=self.width)
        columns = torch.stack((first, last.masked_fill(self.behind, 0)), dim=1).tolist()
        return [(part, int(a), int(b)) for part, (a, b) in enumerate(columns) if a < b]
