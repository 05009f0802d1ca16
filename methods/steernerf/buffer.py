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
from methods.rendering.compaction import kept_indices
from methods.rendering.frame import FeatureFrame
from methods.steernerf.kernels.splat import splat
from methods.steernerf.options import Reprojection
from methods.training.checkpoint import part

SPLAT_ALPHA = 0.1
"""Minimum opacity of a pixel that becomes a point; the depth of a fainter pixel is unreliable."""

OVERLAP_POINTS = 256
"""At most this many evenly spaced points estimate how much of a frame another view shares."""


CLOUD = ("source", "points", "values", "alpha")
"""The tensor attributes of a `Cloud`."""


@dataclass(frozen=True)
class Cloud:
    """The non-empty pixels of a low-resolution frame, as points in the scene.

    On a GPU all pixels are kept (`rendering.compaction`): the points of empty ones have NaN
    coordinates, so that no view sees them. With depths "sum" (`Reprojection`) all are kept as well.

    Attributes:
        camera: the camera of the frame.
        source: [N] row-major index of each point's pixel.
        points: [N, 3] positions in scene units.
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
        """Unproject the pixels of `frame`."""
        alpha, depth = frame.alpha.flatten(), frame.depth.flatten()
        if how.depth == "sum":
            source = torch.arange(len(alpha), device=alpha.device)
            depth = torch.where(alpha > 0, depth.nan_to_num(posinf=0) * alpha, 0) + 1e-12
        else:
            clear = (alpha > SPLAT_ALPHA) & depth.isfinite()
            source = kept_indices(clear)
            depth = torch.where(clear, depth, torch.nan).index_select(0, source)
        camera = frame.camera
        centres = pixel_grid(camera.width, camera.height, alpha.device).index_select(0, source)
        if how.centres == "paper":
            centres = centres - 0.5
        values = frame.values.reshape(len(alpha), -1).index_select(0, source)
        points = unproject(camera, centres, depth)  # Eq. 6
        return cls(camera, source, points, values, alpha.index_select(0, source))

    def expected(self) -> Cloud:
        """Turn a cloud with depths sum w t into one with sum w t / sum w, without faint points."""
        clear = self.alpha > SPLAT_ALPHA
        kept, centre = kept_indices(clear), self.camera.c2w[:, 3]
        alpha = torch.where(clear, self.alpha, torch.nan)[kept]
        points = centre + (self.points[kept] - centre) / alpha[:, None]
        return Cloud(self.camera, self.source[kept], points, self.values[kept], alpha)

    def splat(self, camera: Camera, how: Reprojection, backend: str) -> tuple[Tensor, Tensor]:
        """Find the point that each pixel of `camera` shows.

        Returns:
            [H, W] int32 index of the point, -1 for none; and [N] z-depth of the points.
        """
        pixels, depth = project(camera, self.points)  # Eq. 7 at low resolution, Eq. 9 at full
        if how.centres == "paper":
            pixels = pixels + 0.5  # the paper centres pixel i at i
        size = camera.width, camera.height
        index = splat(pixels, depth, *size, rule=how.rule, backend=backend)  # Eq. 8, Eq. 10
        return index, depth

    def overlap(self, camera: Camera) -> Tensor:
        """Estimate the share of what this frame shows that `camera` can see, 0 to 1.

        Every point inside the other picture counts (1 + cos t) / 2, where t is the angle between
        the two views of it: on a ball, the share of the visible disc that both cameras see.
        Occlusion is ignored. A frame that shows nothing gives 0.

        Returns:
            A scalar tensor on the device of the cloud.
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
    """What the buffer keeps of a frame: its `cloud`, and the `picture` [H, W, 3] that `camera` saw,
    None if no later frame reads it."""

    cloud: Cloud
    camera: Camera
    picture: Tensor | None


class RenderingBuffer:
    """The last `length` frames of a sequence; older ones are dropped."""

    def __init__(self, length: int) -> None:
        self._frames: deque[Remembered] = deque(maxlen=length)

    @property
    def frames(self) -> Sequence[Remembered]:
        """The stored frames, newest first; fewer than `length` after a cold start."""
        return tuple(self._frames)

    def push(self, frame: Remembered) -> None:
        """Store `frame`; drop the oldest one if the buffer is full."""
        self._frames.appendleft(frame)

    def copy(self) -> RenderingBuffer:
        """An independent buffer with the same frames."""
        other = RenderingBuffer(self._frames.maxlen or 0)
        other._frames.extend(self._frames)
        return other

    def state(self) -> dict[str, Tensor]:
        """All stored frames, to be kept in a file."""
        tensors: dict[str, Tensor] = {}
        for age, frame in enumerate(self._frames):
            tensors |= {f"{age}.{name}": x for name, x in _packed(frame).items()}
        return tensors

    def restore(self, tensors: Mapping[str, Tensor], device: torch.device) -> None:
        """Restore on `device` what `state` of another buffer returned."""
        ages = sum(name.endswith(".camera") for name in tensors)
        frames = (_unpacked(part(tensors, f"{age}."), device) for age in range(ages))
        self._frames = deque(frames, self._frames.maxlen)

    def reset(self) -> None:
        """Drop all frames: a new sequence starts."""
        self._frames.clear()


def _packed(frame: Remembered) -> dict[str, Tensor]:
    parts = {name: getattr(frame.cloud, name) for name in CLOUD}
    parts |= {"cloud_camera": pack_camera(frame.cloud.camera), "camera": pack_camera(frame.camera)}
    return parts if frame.picture is None else parts | _packed_picture(frame.picture)


def _packed_picture(picture: Tensor) -> dict[str, Tensor]:
    """Keep only the pixels that differ from the first one: most are background."""
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
