"""The rendering buffer: preceding frames as points, reprojected into the present view."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import (
    pack_camera,
    pixel_grid,
    place_camera,
    project,
    unpack_camera,
    unproject,
    within,
)
from bench.types import Camera
from methods.kernels.splat import splat
from methods.rendering.compaction import kept_indices
from methods.rendering.frame import FeatureFrame
from methods.steernerf.options import Reprojection
from methods.training.checkpoint import part

SPLAT_ALPHA = 0.1
"""Least opacity of a pixel that becomes a point: the depth of a fainter one means little."""

OVERLAP_POINTS = 256
"""Points, evenly spread, that tell how much of a frame another view shares."""


CLOUD = ("source", "points", "values", "alpha")
"""The tensors of a cloud."""


@dataclass(frozen=True)
class Cloud:
    """The pixels of a low-resolution frame that show something, as points in the scene.

    On a GPU they are all pixels (`rendering.compaction`), and a point that shows nothing lies
    nowhere: its coordinates are NaN, and no view sees it.

    Attributes:
        camera: of the frame.
        source: [N] index of each point's pixel, row by row.
        points: [N, 3].
        values: [N, K] features.
        alpha: [N] opacity.
    """

    camera: Camera
    source: Tensor
    points: Tensor
    values: Tensor
    alpha: Tensor

    @classmethod
    def of(cls, frame: FeatureFrame, how: Reprojection) -> Cloud:
        """The points of `frame`."""
        alpha, depth = frame.alpha.flatten(), frame.depth.flatten()
        if how.depth == "sum":
            source = torch.arange(len(alpha), device=alpha.device)
            depth = torch.where(alpha > 0, depth.nan_to_num(posinf=0) * alpha, 0) + 1e-12
        else:
            clear = (alpha > SPLAT_ALPHA) & depth.isfinite()
            source = kept_indices(clear)
            depth = torch.where(clear, depth, torch.nan)[source]
        camera = frame.camera
        centres = pixel_grid(camera.width, camera.height, alpha.device)[source]
        if how.centres == "paper":
            centres = centres - 0.5
        values = frame.values.reshape(len(alpha), -1)[source]
        points = unproject(camera, centres, depth)  # Eq. 6
        return cls(camera, source, points, values, alpha[source])

    def expected(self) -> Cloud:
        """Of a cloud of sums w t: its points at the depths sum w t / sum w, without the faint."""
        clear = self.alpha > SPLAT_ALPHA
        kept, centre = kept_indices(clear), self.camera.c2w[:, 3]
        alpha = torch.where(clear, self.alpha, torch.nan)[kept]
        points = centre + (self.points[kept] - centre) / alpha[:, None]
        return Cloud(self.camera, self.source[kept], points, self.values[kept], alpha)

    def splat(self, camera: Camera, how: Reprojection, backend: str) -> tuple[Tensor, Tensor]:
        """Which point each pixel of `camera` shows.

        Returns:
            [H, W] int32, the index of the point, -1 for none; and [N] the z-depth of the points.
        """
        pixels, depth = project(camera, self.points)  # Eq. 7 at low resolution, Eq. 9 at full
        if how.centres == "paper":
            pixels = pixels + 0.5  # pixel i is at i there, and shows what rounds to it
        size = camera.width, camera.height
        index = splat(pixels, depth, *size, rule=how.rule, backend=backend)  # Eq. 8, Eq. 10
        return index, depth

    def overlap(self, camera: Camera) -> Tensor:
        """About which share of what this frame shows `camera` can see, 0 to 1: [], where it lies.

        An estimate that takes all surfaces for balls: a point inside the other picture counts
        (1 + cos t) / 2, the share of a ball's disc that a camera at an angle of t sees as well.
        Occlusion is ignored. 0 for a frame that shows nothing.
        """
        clear = self.alpha > SPLAT_ALPHA
        number = clear.cumsum(dim=0)  # from 1
        every = (number[-1:] + OVERLAP_POINTS - 1) // OVERLAP_POINTS
        sampled = clear & ((number - 1) % every.clamp(min=1) == 0)
        kept = kept_indices(sampled)
        points = self.points[kept]
        pixels, depth = project(camera, points)
        inside = sampled[kept] & (depth > 0) & within(pixels, camera.width, camera.height)
        here, there = (points - view.c2w[:3, 3] for view in (self.camera, camera))
        seen = (1 + functional.cosine_similarity(here, there, dim=1)) / 2
        share = torch.where(inside, seen, 0).sum() / sampled.sum()
        return share.nan_to_num(nan=0.0)


@dataclass(frozen=True)
class Remembered:
    """What is kept of a frame: its `cloud`, and its `picture` [H, W, 3] as `camera` saw it, None
    where no frame to come reads it."""

    cloud: Cloud
    camera: Camera
    picture: Tensor | None


class RenderingBuffer:
    """The last `length` frames of a sequence; more are forgotten."""

    def __init__(self, length: int) -> None:
        self._frames: deque[Remembered] = deque(maxlen=length)

    @property
    def frames(self) -> Sequence[Remembered]:
        """Newest first; fewer than `length` after a cold start."""
        return tuple(self._frames)

    def push(self, frame: Remembered) -> None:
        """Remember `frame`, forget the oldest one if there are too many."""
        self._frames.appendleft(frame)

    def copy(self) -> RenderingBuffer:
        """A buffer that has seen the same frames, and goes on by itself."""
        other = RenderingBuffer(self._frames.maxlen or 0)
        other._frames.extend(self._frames)
        return other

    def state(self) -> dict[str, Tensor]:
        """All that is remembered, to be kept in a file."""
        tensors: dict[str, Tensor] = {}
        for age, frame in enumerate(self._frames):
            tensors |= {f"{age}.{name}": x for name, x in _packed(frame).items()}
        return tensors

    def restore(self, tensors: Mapping[str, Tensor], device: torch.device) -> None:
        """Remember on `device` what `state` gave of another buffer."""
        ages = sum(name.endswith(".camera") for name in tensors)
        frames = (_unpacked(part(tensors, f"{age}."), device) for age in range(ages))
        self._frames = deque(frames, self._frames.maxlen)

    def reset(self) -> None:
        """Forget all: a new sequence starts."""
        self._frames.clear()


def _packed(frame: Remembered) -> dict[str, Tensor]:
    parts = {name: getattr(frame.cloud, name) for name in CLOUD}
    parts |= {"cloud_camera": pack_camera(frame.cloud.camera), "camera": pack_camera(frame.camera)}
    return parts if frame.picture is None else parts | _packed_picture(frame.picture)


def _packed_picture(picture: Tensor) -> dict[str, Tensor]:
    """Only what differs from its first pixel: most of it is background."""
    pixels = picture.flatten(0, 1)
    places = (pixels != pixels[0]).any(dim=1).nonzero().squeeze(1)
    return {"background": pixels[0].clone(), "places": places.int(), "pixels": pixels[places]}


def _unpacked(tensors: Mapping[str, Tensor], device: torch.device) -> Remembered:
    cloud_camera, camera = (
        place_camera(unpack_camera(tensors[name]), device) for name in ("cloud_camera", "camera")
    )
    cloud = Cloud(cloud_camera, **{name: tensors[name].to(device) for name in CLOUD})
    if "background" not in tensors:
        return Remembered(cloud, camera, None)
    picture = tensors["background"].repeat(camera.height * camera.width, 1)
    picture[tensors["places"].long()] = tensors["pixels"]
    return Remembered(cloud, camera, picture.view(camera.height, camera.width, 3).to(device))
