"""One frame of SteerNeRF, from top to bottom, following Section 3 of the paper.

| stage                | what it does                                            | equations |
|----------------------|---------------------------------------------------------|-----------|
| depth_reprojection   | a reprojected depth prior limits where rays are sampled | 7, 8      |
| field                | features F and depth D at h x w = H/s x W/s             | 2 to 5    |
| feature_reprojection | preceding features at H x W                             | 9, 10     |
| renderer2d           | the 2D neural renderer draws the picture                | 11        |
| finish               | F and D are stored as points, for later frames          | 6         |

Beyond the paper, and off in its method: the preceding picture is reprojected (`history`), the
field is evaluated at the surface of each pixel (`surface`), and the field itself renders the cells
with the largest estimated error (`refinement`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import place_camera
from bench.types import Camera, Frame, NullProbe, Probe
from methods.kernels.types import Occupancy
from methods.rendering.field import Field
from methods.rendering.frame import FeatureFrame, Render, everywhere, render_frame
from methods.rendering.rays import render_rays
from methods.steernerf.buffer import Cloud, Remembered, RenderingBuffer
from methods.steernerf.options import Model, Rendering
from methods.steernerf.range_reduction import depth_interval
from methods.steernerf.renderer import (
    Detail,
    Observation,
    Points,
    Renderer2d,
    cells_at_matter,
)
from methods.steernerf.view import View
from methods.steernerf_lean import window
from methods.steernerf_lean.cells import put_pixels
from methods.steernerf_lean.kernels.warp import enlarge, warp
from methods.steernerf_lean.refinement import rays_of_cells, refined_sampling, worst_cells
from methods.steernerf_lean.surface import surface_points


class Pipeline:
    """A field and a 2D renderer that together render frames, one after the other.

    Args:
        field: a field with `model.channels` features.
        occupancy: where the field may hold matter.
        background: [3] background colour of the scene.
        renderer: the 2D renderer; may be replaced later.
        model: what both are trained for.
    """

    def __init__(
        self,
        field: Field,
        occupancy: Occupancy,
        background: Tensor,
        renderer: Renderer2d,
        model: Model,
    ) -> None:
        self.field, self.occupancy, self.renderer = field, occupancy, renderer
        self.model, self.backend = model, field.backend
        self.background = functional.pad(
            background, (0, model.channels - 3), value=model.feature_background
        )  # [K]

    def view(self, camera: Camera) -> View:
        """The view of `camera`, on the device of the field."""
        return View.of(place_camera(camera, self.background.device), self.model.scale)

    @torch.no_grad()
    def render(
        self, camera: Camera, buffer: RenderingBuffer, rendering: Rendering, probe: Probe
    ) -> Frame:
        """Render the frame that follows those in `buffer`, and store it there."""
        model, view = self.model, self.view(camera)
        preceding = self.overlapping(buffer.frames, view, rendering, probe)
        frame = self.features(view, preceding, rendering, probe)  # F, D
        with probe.stage("feature_reprojection"):
            points = [self.reproject(old.cloud, view) for old in preceding]
            newest = preceding[0] if preceding else None
            observation = self.observe(frame, points, newest, view, rendering, probe)
        with probe.stage("renderer2d"):
            drawing = self.renderer([observation], probe)  # Eq. 11
            picture = drawing.pictures[0].clamp_(0, 1)  # I
        if rendering.refined and drawing.error is not None:
            with probe.stage("refinement"):
                cells = observation.cells[worst_cells(drawing.error, rendering.refined)]
                colours = self.refined(cells, frame, view, rendering, probe)
                put_pixels(picture, cells, model.scale, colours)
        with probe.stage("finish"):
            kept = picture if model.history else None
            buffer.push(Remembered(Cloud.of(frame, model.reprojection), view.full, kept))
            return _finished(camera, picture, frame, model.scale)

    @torch.no_grad()
    def remember(self, camera: Camera, buffer: RenderingBuffer, rendering: Rendering) -> None:
        """Update `buffer` as `render` does, but draw the picture only if later frames read it."""
        probe = NullProbe()
        if self.model.history:
            self.render(camera, buffer, rendering, probe)
            return
        view = self.view(camera)
        preceding = self.overlapping(buffer.frames, view, rendering, probe)
        frame = self.features(view, preceding, rendering, probe)
        buffer.push(Remembered(Cloud.of(frame, self.model.reprojection), view.full, None))

    def overlapping(
        self, frames: Sequence[Remembered], view: View, rendering: Rendering, probe: Probe
    ) -> Sequence[Remembered]:
        """Select the preceding `frames` that share enough with `view`."""
        if frames and (least := rendering.overlap):
            with probe.stage("feature_reprojection"):
                shares = torch.stack([f.cloud.overlap(view.full) for f in frames]).tolist()
                frames = [f for f, share in zip(frames, shares, strict=True) if share >= least]
        probe.count("preceding_frames", len(frames), self.model.frames)
        return frames

    def features(
        self, view: View, preceding: Sequence[Remembered], rendering: Rendering, probe: Probe
    ) -> FeatureFrame:
        """Render features and depth at low resolution (Eq. 2 to 5). With range reduction, rays are
        sampled only near the depth of the newest of the `preceding` frames."""
        newest = preceding[0].cloud if preceding else None
        render = self._marcher(newest, view, rendering, probe)
        with probe.stage("field"):
            occupancy = self._occupied(rendering)
            return render_frame(view.low, occupancy, self.background, probe, render)

    def _marcher(
        self, newest: Cloud | None, view: View, rendering: Rendering, probe: Probe
    ) -> Render:
        """Make the argument `render` of `render_frame`, which marches the low-resolution rays."""
        occupancy, how, reduction = self._occupied(rendering), rendering.sampling, rendering.range
        if newest is None or reduction.mode == "off":
            return everywhere(self.field, occupancy, probe, how)
        reprojection = self.model.reprojection
        with probe.stage("depth_reprojection"):
            if reprojection.depth == "sum" and reduction.depth == "expected":
                newest = newest.expected()
            by = newest, view.low, reduction.epsilon, reprojection, self.backend
            if reduction.mode == "window":
                prior = window.depth_prior(*by)
                return window.within(self.field, occupancy, probe, how, prior)
            how = how.within(depth_interval(*by).view(-1, 2))  # D - epsilon to D + epsilon
            return everywhere(self.field, occupancy, probe, how)

    def reproject(self, cloud: Cloud, view: View) -> Points:
        """Reproject the features of a preceding frame into the present view (Eq. 9, 10)."""
        index, _ = cloud.splat(view.full, self.model.reprojection, self.backend)
        return Points(cloud.values, index)

    def observe(
        self,
        frame: FeatureFrame,
        preceding: Sequence[Points],
        newest: Remembered | None,
        view: View,
        rendering: Rendering,
        probe: Probe,
        cells: Tensor | None = None,
    ) -> Observation:
        """Collect the input of the 2D renderer: the present `frame`, the `preceding` features and,
        beyond the paper, the `newest` preceding picture and the field at the surface.

        Args:
            cells: the cells near matter; None: they are found here, and the host waits for a GPU.
        """
        model = self.model
        if not self.leaves_out(rendering):
            cells = torch.arange(frame.alpha.numel(), device=frame.alpha.device)
        elif cells is None:
            cells = cells_at_matter(frame.alpha, preceding)
        history = surface = None
        if model.history or model.surface:
            depth = enlarge(frame.depth.detach(), cells, model.scale, backend=self.backend)
            if model.surface:
                with probe.stage("surface"):
                    surface = surface_points(self.field, depth, cells, view, model.scale, probe)
            if newest is not None and newest.picture is not None:
                history = self._history(newest, newest.picture, depth, cells, view)
        return Observation(frame, self.background, preceding, cells, history, surface, self.backend)

    def leaves_out(self, rendering: Rendering) -> bool:
        """Whether the 2D renderer draws only the cells near matter."""
        return rendering.skip.background and self.renderer.draws_cells

    def _history(
        self, newest: Remembered, picture: Tensor, depth: Tensor, cells: Tensor, view: View
    ) -> Detail:
        """Warp the preceding `picture` into `cells`, whose present depth is `depth` [N, s^2]."""
        values, valid = warp(
            picture,
            newest.camera,
            depth,
            cells,
            view.full,
            self.model.scale,
            backend=self.backend,
        )
        return Detail(values, valid)

    def refined(
        self, cells: Tensor, frame: FeatureFrame, view: View, rendering: Rendering, probe: Probe
    ) -> Tensor:
        """Render the colours [n, s^2, 3] of `cells` [n] with a ray through each of their pixels."""
        rays = rays_of_cells(cells, view)
        how = refined_sampling(cells, frame, view.scale, rendering)
        probe.count("refined_rays", len(rays.origins), view.full.width * view.full.height)
        found = render_rays(self.field, rays, self._occupied(rendering), probe, how)
        colours = found.over(self.background).values[:, :3]
        return colours.clamp_(0, 1).view(len(cells), view.scale**2, 3)

    def _occupied(self, rendering: Rendering) -> Occupancy:
        """Where rays take samples."""
        return self.occupancy if rendering.skip.empty else self._everywhere

    @cached_property
    def _everywhere(self) -> Occupancy:
        return Occupancy(torch.ones_like(self.occupancy.cells))


def _finished(camera: Camera, picture: Tensor, frame: FeatureFrame, scale: int) -> Frame:
    """The frame for the harness, with depth and opacity of the nearest low-resolution pixel."""
    size = slice(0, camera.height), slice(0, camera.width)
    depth, alpha = (
        image.repeat_interleave(scale, 1).repeat_interleave(scale, 0)[size]
        for image in (frame.depth, frame.alpha)
    )
    return Frame(picture[size], depth, alpha)
