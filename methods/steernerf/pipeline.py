"""SteerNeRF's rendering of one frame, top-down beside Section 3 of the paper.

depth_reprojection    the newest preceding depth narrows where rays look     Eq. 6 to 8
field                 features, depth and opacity at h x w = H/s x W/s       Eq. 3 to 5
feature_reprojection  preceding features, and the preceding picture, at H x W   Eq. 9, 10
renderer2d            the 2D neural renderer                                 Eq. 11
refinement            the field at H x W, where the 2D renderer doubts itself   not in the paper
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, place_camera
from bench.types import Camera, Frame, Probe
from methods.instant_ngp.field import HashField
from methods.kernels.march import Occupancy
from methods.kernels.warp import enlarge, warp
from methods.rendering.batch import FeatureFrame
from methods.rendering.occupancy import STEP
from methods.rendering.rays import render_rays
from methods.steernerf.beyond.cells import centres, put_pixels
from methods.steernerf.beyond.surface import Surface
from methods.steernerf.buffer import Cloud, Remembered, RenderingBuffer
from methods.steernerf.options import PipelineOptions
from methods.steernerf.range_reduction import depths_around, evidence, render_guided
from methods.steernerf.refresh import first_ages, known_pixels
from methods.steernerf.renderer import (
    Detail,
    Observation,
    Points,
    Renderer2d,
    cells_at_matter,
)
from methods.steernerf.view import View


class Pipeline:
    """A field and a 2D renderer that together render frames, one after the other.

    Args:
        field: with `options.channels` features.
        background: [3] of the scene.

    Raises:
        ValueError: see `PipelineOptions.check`.
    """

    def __init__(
        self,
        field: HashField,
        occupancy: Occupancy,
        background: Tensor,
        renderer: Renderer2d,
        options: PipelineOptions,
    ) -> None:
        options.check(field.grid, renderer)
        self.field, self.renderer = field, renderer
        self.options, self.backend = options, field.backend
        skip = options.skip
        self.occupancy = occupancy if skip.empty else Occupancy(torch.ones_like(occupancy.cells))
        self.stop = options.stop if skip.hidden else 0.0
        self.background = functional.pad(
            background, (0, options.channels - 3), value=options.feature_background
        )  # [K]

    @property
    def low_field(self) -> HashField:
        """The field as low-resolution rays read it."""
        levels = self.options.levels
        return self.field if levels is None else self.field.coarse(levels)

    def view(self, camera: Camera, turn: int) -> View:
        """The view of the `turn`-th frame of a sequence, where the field is."""
        camera = place_camera(camera, self.background.device)
        return View.of(camera, self.options.scale, turn, jitter=self.options.jitter)

    def render(self, camera: Camera, buffer: RenderingBuffer, probe: Probe) -> Frame:
        """Render one frame that follows those in `buffer`, and remember it there."""
        glance = self.glance(camera, buffer.clouds, buffer.turn, probe)
        return self.draw(camera, glance, buffer, probe)

    @torch.no_grad()
    def glance(self, camera: Camera, clouds: Sequence[Cloud], turn: int, probe: Probe) -> Glance:
        """The `turn`-th frame of a sequence, as far as it needs no pictures of those before it: it
        has all to do with their `clouds`, newest first."""
        options, view = self.options, self.view(camera, turn)
        used = self.shared(clouds, view, probe)
        features, ages = self._features(view, clouds, used, probe)
        with probe.stage("feature_reprojection"):
            preceding = [self.reproject(clouds[number], view) for number in used]
            sight = self.sight(features, preceding, view, probe)
        with probe.stage("finish"):
            cloud = Cloud.of(features, options.reprojection, ages)
        return Glance(view, features, cloud, used, preceding, sight)

    @torch.no_grad()
    def draw(self, camera: Camera, glance: Glance, buffer: RenderingBuffer, probe: Probe) -> Frame:
        """The rest of the frame that follows those in `buffer`; it is remembered there."""
        options, view, features = self.options, glance.view, glance.features
        newest = buffer.frames[glance.used[0]] if glance.used else None
        with probe.stage("feature_reprojection"):
            observation = self.observe(
                features, glance.preceding, newest, view, glance.sight, probe
            )
        with probe.stage("renderer2d"):
            drawing = self.renderer([observation], probe)
            picture = drawing.pictures[0].clamp_(0, 1)
        if options.refined and drawing.doubt is not None:
            with probe.stage("refinement"):
                worst = observation.cells[most_doubted(drawing.doubt, options.refined)]
                colours = self.refine(worst, features, view, probe).clamp_(0, 1)
                put_pixels(picture, worst, options.scale, colours)
        with probe.stage("finish"):
            buffer.push(Remembered(glance.cloud, view.full, picture))
            return _finish(camera, picture, features, options.scale)

    def shared(self, clouds: Sequence[Cloud], view: View, probe: Probe) -> Sequence[int]:
        """Which of the preceding frames show enough of what is in `view`."""
        used: Sequence[int] = range(len(clouds))
        if least := self.options.overlap:
            with probe.stage("feature_reprojection"):
                used = [number for number in used if clouds[number].overlap(view.full) >= least]
        probe.count("preceding_frames", len(used), self.options.frames)
        return used

    def reproject(self, cloud: Cloud, view: View) -> Points:
        """The features of a preceding frame where the present picture sees them."""
        index, _ = cloud.land(view.full, self.options.reprojection, self.backend)
        return Points(cloud.values, index)

    def sight(
        self, frame: FeatureFrame, preceding: Sequence[Points], view: View, probe: Probe
    ) -> Sight:
        """Where matter is seen in `view`, by its `frame` and the `preceding` ones."""
        options = self.options
        if options.skip.background:
            cells = cells_at_matter(frame.alpha, preceding)
        else:
            cells = torch.arange(frame.alpha.numel(), device=frame.alpha.device)
        probe.count("cells", len(cells), frame.alpha.numel())
        if not (options.history or options.surface):
            return Sight(cells)
        depth = frame.depth.detach()
        depth = enlarge(depth, cells, options.scale, backend=self.backend)
        if not options.surface:
            return Sight(cells, depth)
        with probe.stage("surface"):
            surface = Surface(self.field, depth, cells, view, options.scale)
        probe.count("surface_samples", len(surface), view.full.width * view.full.height)
        return Sight(cells, depth, surface)

    def observe(
        self,
        frame: FeatureFrame,
        preceding: Sequence[Points],
        newest: Remembered | None,
        view: View,
        sight: Sight,
        probe: Probe,
    ) -> Observation:
        """All that is known of the picture of `view` from its `frame`, the `preceding` ones, and
        its `sight`."""
        cells, history = sight.cells, None
        if newest is not None and sight.depth is not None and self.options.history:
            history = self.history(newest, sight.depth, cells, view)
        surface = sight.surface.points(probe) if sight.surface else None
        return Observation(
            frame, self.background, preceding, cells, history, surface, view.phase, self.backend
        )

    def history(self, newest: Remembered, depth: Tensor, cells: Tensor, view: View) -> Detail:
        """The preceding picture where the present one, of `depth` [N, s^2] in `cells`, sees it."""
        scale, backend = self.options.scale, self.backend
        values, valid = warp(
            newest.picture, newest.camera, depth, cells, view.full, scale, backend=backend
        )
        return Detail(values, valid)

    def refine(self, cells: Tensor, frame: FeatureFrame, view: View, probe: Probe) -> Tensor:
        """Colours [n, s^2, 3] of `cells` [n], by a ray of the field through each of their pixels.

        With range reduction in mode "window" rays look where the low-resolution `frame` has
        something around their cell.
        """
        options = self.options
        pixels = centres(cells, view.low.width, options.scale)
        window = None
        if options.range.mode == "window":
            # Between the samples of the frame a surface may lie farther off.
            window = depths_around(frame.depth, 2 * options.range.epsilon).view(-1, 2)[cells]
            window = window.repeat_interleave(options.scale**2, dim=0)
        probe.count("refined_rays", pixels[..., 0].numel(), view.full.width * view.full.height)
        found = render_rays(
            self.field,
            cast(view.full, pixels.flatten(0, 1)),
            self.occupancy,
            probe,
            stop=self.stop,
            step=options.refined_steps * STEP,
            window=window,
        )
        colours = found.values[:, :3] + (1 - found.alpha)[:, None] * self.background[:3]
        return colours.view(*pixels.shape[:2], 3)

    def _features(
        self, view: View, clouds: Sequence[Cloud], used: Sequence[int], probe: Probe
    ) -> tuple[FeatureFrame, Tensor | None]:
        """The field at low resolution, looked at where the newest of the `used` frames says and
        what the frame just before shows does not suffice; and the ages of the pixels."""
        options, found, known, ages = self.options, None, None, None
        how = options.reprojection, self.backend
        if used and options.range.mode != "off":
            with probe.stage("depth_reprojection"):
                found = evidence(clouds[used[0]], view.low, options.range, *how)
        if 0 in used and options.refresh.age:
            with probe.stage("depth_reprojection"):
                known = known_pixels(clouds[0], view.low, options.refresh, *how)
        with probe.stage("field"):
            features = render_guided(
                self.low_field,
                view.low,
                self.occupancy,
                self.background,
                probe,
                found,
                stop=self.stop,
                step=options.steps * STEP,
                known=None if known is None else known.pixels,
            )
            if known is not None:
                probe.count("known_pixels", len(known.pixels), features.alpha.numel())
                features, ages = known.put(features), known.ages(view.low)
            elif options.refresh.age:
                ages = first_ages(view.low, options.refresh, self.background.device)
        return features, ages


@dataclass(frozen=True)
class Sight:
    """Where matter is seen in a picture.

    Attributes:
        cells: [N] that have any.
        depth: [N, s^2] of their pixels, +inf where there is none; None: of no use.
        surface: what the field has there; None: of no use.
    """

    cells: Tensor
    depth: Tensor | None = None
    surface: Surface | None = None


@dataclass(frozen=True)
class Glance:
    """What is known of a frame before the pictures of the preceding ones are.

    Attributes:
        view: of its camera.
        features: the field at low resolution.
        cloud: the same as points, to be remembered.
        used: which of the preceding frames show enough of the view, 0 for the newest.
        preceding: their features in it.
        sight: where matter is seen.
    """

    view: View
    features: FeatureFrame
    cloud: Cloud
    used: Sequence[int]
    preceding: Sequence[Points]
    sight: Sight


def most_doubted(doubt: Tensor, share: float) -> Tensor:
    """Which of N cells, `share` of them, have the largest `doubt` [N]."""
    return doubt.topk(math.ceil(share * len(doubt)), sorted=False).indices


def _finish(camera: Camera, picture: Tensor, features: FeatureFrame, scale: int) -> Frame:
    """What the harness asks for: depth and opacity of the nearest low-resolution pixel."""
    size = slice(0, camera.height), slice(0, camera.width)
    depth, alpha = (
        image.repeat_interleave(scale, 0).repeat_interleave(scale, 1)[size]
        for image in (features.depth, features.alpha)
    )
    return Frame(picture[size], depth, alpha)
