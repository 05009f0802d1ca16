"""A frame of a field: features, depth and opacity of every pixel of a camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.cameras import cast, project
from bench.types import EMPTY_ALPHA, Camera, Frame, Probe, Rays
from methods.kernels.types import BRICK, Occupancy, Pixels
from methods.rendering.field import Field
from methods.rendering.rays import render_rays
from methods.rendering.sampling import Sampling

Render = Callable[[Tensor, Rays], Pixels]
"""Renders some pixels of a frame, given their row-major indices [P] and their rays."""


@dataclass(frozen=True)
class FeatureFrame:
    """A field as a camera sees it: F and D of SteerNeRF.

    Attributes:
        camera: a camera of w x h pixels.
        values: [h, w, K] features on the background; the first three are RGB.
        depth: [h, w] z-depth, +inf where a pixel is empty.
        alpha: [h, w] opacity.
    """

    camera: Camera
    values: Tensor
    depth: Tensor
    alpha: Tensor

    @classmethod
    def of(cls, camera: Camera, pixels: Pixels, background: Tensor) -> FeatureFrame:
        """Make a frame of all pixels of `camera`, and composite them on `background` [K]."""
        values = pixels.over(background).values
        seen = pixels.alpha > EMPTY_ALPHA
        depth = torch.where(seen, pixels.depth_sum / pixels.alpha, torch.inf)
        shape = (camera.height, camera.width)
        return cls(camera, values.view(*shape, -1), depth.view(shape), pixels.alpha.view(shape))

    def picture(self) -> Frame:
        """The picture of a field that has no features beyond RGB."""
        return Frame(self.values, self.depth, self.alpha)


@torch.no_grad()
def render_frame(
    camera: Camera,
    occupancy: Occupancy,
    background: Tensor,
    probe: Probe,
    render: Render,
) -> FeatureFrame:
    """Render the frame of `camera`, composited on `background` [K].

    Args:
        render: renders the pixels that may see matter.
    """
    size = camera.height * camera.width
    with probe.stage("rays"):
        seen, rays = rays_at_matter(camera, occupancy)
        canvas = Pixels.blank(size, len(background), background.device)
    probe.count("rays", len(seen), size)
    rendered = render(seen, rays)
    with probe.stage("finish"):
        canvas.put(seen, rendered)
        return FeatureFrame.of(camera, canvas, background)


def everywhere(field: Field, occupancy: Occupancy, probe: Probe, how: Sampling) -> Render:
    """Make the argument `render` of `render_frame` that marches whole rays, or marches them within
    `how.window` [h * w, 2], which is given for all pixels."""

    def render(seen: Tensor, rays: Rays) -> Pixels:
        window = None if how.window is None else how.window[seen]
        return render_rays(field, rays, occupancy, probe, how.within(window))

    return render


def rays_at_matter(camera: Camera, occupancy: Occupancy) -> tuple[Tensor, Rays]:
    """The pixels that may see an occupied cell, as row-major indices [P], and their rays. The host
    waits for a GPU once."""
    row, column = sees_matter(camera, occupancy).nonzero().unbind(dim=1)
    return row * camera.width + column, cast(camera, torch.stack((column, row), dim=1) + 0.5)


def sees_matter(camera: Camera, occupancy: Occupancy) -> Tensor:
    """Which pixels may see an occupied cell: [h, w] bool.

    A pixel may see an occupied brick if it lies in the bounding box of the brick's projected
    corners; if one of the corners is not in front of the camera, every pixel may.
    """
    device = camera.c2w.device
    bricks = occupancy.bricks.to(device)
    unit = torch.arange(2, device=device)
    corners = (bricks[:, None] + torch.cartesian_prod(unit, unit, unit)) * BRICK
    projected, depth = project(camera, corners.reshape(-1, 3) / occupancy.resolution)
    projected, sides = projected.view(-1, 8, 2), (camera.width, camera.height)
    behind = (depth.view(-1, 8) <= 0).any(dim=1)[:, None]  # [B, 1]

    low = torch.where(behind, 0, projected.amin(dim=1)).floor()
    high = torch.where(behind, torch.inf, projected.amax(dim=1)).ceil()
    (left, top), (right, bottom) = (
        [x.clamp(0, size).long() for x, size in zip(ends.unbind(dim=1), sides, strict=True)]
        for ends in (low, high)
    )

    # How many boxes cover a pixel: the 2D prefix sum, from the top left, of +1 and -1 at
    # the corners of the boxes.
    edges = torch.zeros(camera.height + 1, camera.width + 1, dtype=torch.int32, device=device)
    for row, column, sign in (
        (top, left, 1),
        (top, right, -1),
        (bottom, left, -1),
        (bottom, right, 1),
    ):
        edges.index_put_((row, column), edges.new_full((), sign), True)
    return edges.cumsum(dim=0).cumsum(dim=1)[:-1, :-1] != 0
