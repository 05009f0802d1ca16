"""Adaptive refresh: low-resolution rays that are not rendered anew where the frame before knows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import pixel_grid, project, unproject
from bench.types import Camera
from methods.rendering.batch import FeatureFrame
from methods.steernerf.buffer import Cloud, Reprojection
from methods.steernerf.range_reduction import depths_around, landed

OPAQUE = 0.95
"""Least opacity of the pixels around: behind a fainter one something else moves."""

DEPTH_EDGE = 0.06
"""Depths of a neighbourhood, in scene units, that differ by more than this are those of an edge."""

LANDED = 0.7
"""Share of a neighbourhood on which points must land. On a pixel here and there of a surface none
does; of the neighbourhood of a pixel at its outline a third is empty."""

DEPTH_TOLERANCE = 0.01
"""What is between depths, in scene units, may differ by this much from the nearest one."""

BLOCK = 8
"""Side, in pixels, of the blocks that grow old together after a cold start: were it the whole
picture, every frame would take another time."""

OLDEST = 255
"""Ages are kept in a byte."""


@dataclass(frozen=True)
class Refresh:
    """When a pixel of the low-resolution frame is taken over from the one just before it.

    Attributes:
        age: frames in a row that it may be; 0: every ray is rendered in every frame.
        tolerance: what is between the samples of the preceding frame may differ by this much from
            the nearest one, of features in [0, 1].
    """

    age: int = 0
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        if not 0 <= self.age <= OLDEST:
            raise ValueError(f"refresh.age: expected 0 to {OLDEST} frames, got {self.age}")
        if not 0 <= self.tolerance <= 1:
            raise ValueError(f"refresh.tolerance: expected 0 to 1, got {self.tolerance}")


@dataclass(frozen=True)
class Known:
    """Pixels of a view that the frame before shows.

    Attributes:
        pixels: [P] indices, row by row.
        values: [P, K] features.
        depth: [P] z-depth.
        alpha: [P] opacity.
        age: [P] uint8, frames since the oldest of what they are made of was rendered.
    """

    pixels: Tensor
    values: Tensor
    depth: Tensor
    alpha: Tensor
    age: Tensor

    def put(self, frame: FeatureFrame) -> FeatureFrame:
        """`frame` with these pixels."""
        parts = {}
        for name in ("values", "depth", "alpha"):
            image = getattr(frame, name).clone()
            image.flatten(0, 1)[self.pixels] = getattr(self, name)
            parts[name] = image
        return replace(frame, **parts)

    def ages(self, camera: Camera) -> Tensor:
        """[h * w] uint8, the age of every pixel of `camera`: of all others 0."""
        ages = self.age.new_zeros(camera.height * camera.width)
        ages[self.pixels] = self.age
        return ages


def known_pixels(
    cloud: Cloud, camera: Camera, options: Refresh, reprojection: Reprojection, backend: str
) -> Known:
    """The pixels of `camera`, a low-resolution one, that need not be rendered.

    Where a point of `cloud` lands and no depth edge is near, its frame is looked at where it shows
    the middle of the pixel. The four samples around that place are interpolated if they are opaque,
    young enough, and the nearest of them says the same. A camera that stands still, without jitter,
    meets the samples themselves: it loses nothing.
    """
    index, z = cloud.land(camera, reprojection, backend)
    pixels = inside_surface(landed(z, index, torch.inf)).flatten().nonzero().squeeze(1)
    middles = pixel_grid(camera.width, camera.height, z.device)[pixels]
    points = unproject(camera, middles, z[index.flatten()[pixels].long()])
    around, weights = _samples_around(cloud, project(cloud.camera, points)[0])
    usable = (around >= 0).all(dim=1)
    usable &= (cloud.alpha[around] >= OPAQUE).all(dim=1)
    usable &= (cloud.age[around] < options.age).all(dim=1)
    pixels, around, weights = pixels[usable], around[usable], weights[usable]

    nearest = around.gather(1, weights.argmax(dim=1, keepdim=True)).squeeze(1)
    values, depth, alpha = (
        torch.einsum("pn,pn...->p...", weights, samples[around])
        for samples in (cloud.values, z, cloud.alpha)
    )
    same = ((values - cloud.values[nearest]).abs() <= options.tolerance).all(dim=1)
    same &= (depth - z[nearest]).abs() <= DEPTH_TOLERANCE
    age = cloud.age[around].amax(dim=1) + 1
    return Known(pixels[same], values[same], depth[same], alpha[same], age[same])


def inside_surface(depth: Tensor) -> Tensor:
    """[h, w]: where `depth` [h, w] is finite, that of most of the 3 x 3 neighbourhood, too, and no
    edge is between those."""
    finite = depth.isfinite()
    around = functional.avg_pool2d(finite[None].float(), 3, 1, 1, count_include_pad=False)[0]
    near, far = depths_around(depth, 0.0).unbind(dim=-1)
    return finite & (around > LANDED) & (far - near <= DEPTH_EDGE)


def _samples_around(cloud: Cloud, places: Tensor) -> tuple[Tensor, Tensor]:
    """The points of `cloud` whose pixels are the four around continuous `places` [P, 2], as
    indices [P, 4], -1 where there is none, and their bilinear weights [P, 4]."""
    width, height = cloud.camera.width, cloud.camera.height
    point = torch.full((width * height,), -1, device=places.device)
    point[cloud.source] = torch.arange(len(cloud.source), device=places.device)
    corner = (places - 0.5).floor()
    right, down = (places - 0.5 - corner).unbind(dim=1)
    column, row = (corner.long()[:, :, None] + torch.tensor((0, 1), device=places.device)).unbind(1)
    column, row = column[:, (0, 1, 0, 1)], row[:, (0, 0, 1, 1)]
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    around = torch.where(inside, point[torch.where(inside, row * width + column, 0)], -1)
    weights = torch.stack(
        ((1 - right) * (1 - down), right * (1 - down), (1 - right) * down, right * down), dim=1
    )
    return around, weights


def first_ages(camera: Camera, options: Refresh, device: torch.device) -> Tensor:
    """[h * w] ages of the pixels of a first frame, of all from 0 to `options.age`: higher than they
    are, so that not all of them are rendered anew at once."""
    row = torch.arange(camera.height, device=device) // BLOCK
    column = torch.arange(camera.width, device=device) // BLOCK
    return ((row[:, None] + 2 * column) % (options.age + 1)).flatten().byte()
