"""One frame of SteerNeRF, from top to bottom, following Section 3 of the paper."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import crop_camera, place_camera, scale_camera
from bench.types import Camera, Frame, NullProbe, Probe
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.types import Occupancy
from methods.rendering.compaction import compacts
from methods.rendering.frame import FeatureFrame, everywhere, render_frame
from methods.steernerf.buffer import Buffer, PointCloud
from methods.steernerf.options import ModelOptions, Rendering
from methods.steernerf.unet import WHOLE, Observation, Rectangle, UNet

MARGIN = 8  # pixels at low resolution around matter, which the 2D renderer corrects, too
QUANTUM = 8  # the sides of what it corrects are multiples: libraries prepare code for every size


@dataclass(frozen=True)
class TwoScales:
    """A camera as the pipeline sees it: at both resolutions."""

    full: Camera  # its picture padded to multiples of s; its intrinsics are K_h of Eq. 9
    low: Camera  # the same view at 1/s of the resolution; K_l of Eq. 7
    scale: int  # s

    def crop(self, part: Rectangle) -> Self:
        """The view of a part of the low-resolution pixels."""
        rows, columns = part
        top, bottom, _ = rows.indices(self.low.height)
        left, right, _ = columns.indices(self.low.width)
        s, sides = self.scale, (right - left, bottom - top)
        full = crop_camera(self.full, left * s, top * s, *(side * s for side in sides))
        return replace(self, full=full, low=crop_camera(self.low, left, top, *sides))


class Pipeline:
    """A `trained` field and a 2D `renderer`, both for `model`, that together render frames, one
    after the other, on `background` [3]."""

    def __init__(
        self, trained: TrainedField, background: Tensor, renderer: UNet, model: ModelOptions
    ) -> None:
        self.field, self.occupancy, self.renderer = trained.field, trained.occupancy, renderer
        self.model = model
        more = (0, model.channels - 3)
        background = background.to(trained.field.device)
        self.background = functional.pad(background, more, value=model.feature_background)  # [K]

    def view(self, camera: Camera) -> TwoScales:
        """The view of `camera`, on the device of the field; low resolution is rounded up."""
        s, camera = self.model.scale, place_camera(camera, self.background.device)
        width, height = -(-camera.width // s), -(-camera.height // s)
        full = replace(camera, width=width * s, height=height * s)
        return TwoScales(full, scale_camera(full, width, height), s)

    @torch.no_grad()
    def render(self, camera: Camera, buffer: Buffer, rendering: Rendering, probe: Probe) -> Frame:
        """Render the frame that follows those in `buffer`, and store it there."""
        view = self.view(camera)
        probe.count("preceding_frames", len(buffer), self.model.frames)
        frame = self.features(view, buffer, rendering, probe)  # F, D
        with probe.stage("feature_reprojection"):
            shown = self.observe(frame, buffer, view, rendering, probe)
        with probe.stage("renderer2d"):
            picture = self.renderer([shown], probe)[0].clamp_(0, 1)  # I
        with probe.stage("finish"):
            buffer.appendleft(PointCloud.of(frame))
            size = slice(0, camera.height), slice(0, camera.width)
            # Depth and opacity are those of the nearest low-resolution pixel.
            low = torch.stack((frame.depth, frame.alpha))
            depth, alpha = low.repeat_interleave(view.scale, 2).repeat_interleave(view.scale, 1)
            return Frame(picture[size], depth[size], alpha[size])

    @torch.no_grad()
    def remember(self, camera: Camera, buffer: Buffer, rendering: Rendering) -> None:
        """Update `buffer` as `render` does, but draw no picture: no later frame reads it."""
        frame = self.features(self.view(camera), buffer, rendering, NullProbe())
        buffer.appendleft(PointCloud.of(frame))

    def features(
        self, view: TwoScales, preceding: Sequence[PointCloud], rendering: Rendering, probe: Probe
    ) -> FeatureFrame:
        """Render features F and depth D at low resolution (Eq. 2 to 5). With range reduction, rays
        are sampled only near the depth of the newest of the `preceding` frames (Eq. 7, 8)."""
        how, reduction = rendering.sampling(self.occupancy.contracted), rendering.range
        if preceding and reduction.mode == "paper":
            with probe.stage("depth_reprojection"):
                cloud = preceding[0].expected() if reduction.depth == "expected" else preceding[0]
                how = replace(how, window=cloud.interval(view.low, reduction.epsilon).view(-1, 2))
        with probe.stage("field"):
            where = self.occupancy if rendering.skip.empty else self._cube
            render = everywhere(self.field, where, probe, how)
            return render_frame(view.low, where, self.background, probe, render)

    def observe(
        self,
        frame: FeatureFrame,
        preceding: Sequence[PointCloud],
        view: TwoScales,
        rendering: Rendering,
        probe: Probe,
    ) -> Observation:
        """What the 2D renderer is shown: the present `frame`, and the features of the `preceding`
        ones where `view` shows them (Eq. 9, 10), of the part that is near matter."""
        # On a GPU the host would wait, and every new size would be recorded or built.
        some = rendering.skip.background and compacts(frame.alpha.device)
        part = near_matter(frame.alpha > 0) if some else WHOLE
        drawn = view.crop(part)
        pixels, every = (seen.full.width * seen.full.height for seen in (drawn, view))
        probe.count("drawn_pixels", pixels, every)
        return Observation(frame, [cloud.shown_in(drawn.full) for cloud in preceding], part)

    @cached_property
    def _cube(self) -> Occupancy:
        return self.occupancy.everywhere()


def near_matter(seen: Tensor) -> Rectangle:
    """A rectangle of low-resolution pixels [h, w] around all that are `seen`, and a margin."""
    part = []
    for across in (1, 0):
        size, there = seen.shape[1 - across], seen.any(dim=across).nonzero()
        ends = there[[0, -1], 0].tolist() if len(there) else (0, 0)
        length = min(-(-(ends[1] + 1 - ends[0] + 2 * MARGIN) // QUANTUM) * QUANTUM, size)
        begin = max(min((ends[0] + ends[1] + 1 - length) // 2, size - length), 0)
        part.append(slice(begin, begin + length))
    return part[0], part[1]
