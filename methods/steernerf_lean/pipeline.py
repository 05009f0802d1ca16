"""One frame of the lean SteerNeRF: the steps in which it differs from the paper's `Pipeline`.

The 2D renderer is shown the preceding picture (`history`) and the field at the surface of each
pixel (`surface`), but no features of preceding frames. The field itself then renders the cells with
the largest estimated error (`refinement`).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bench.types import Camera, NullProbe, Probe
from methods.rendering.frame import FeatureFrame, render_rays
from methods.steernerf.buffer import Buffer, Cloud
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.view import View
from methods.steernerf_lean.cells import cells_near, put_pixels
from methods.steernerf_lean.history import Kept, overlap
from methods.steernerf_lean.kernels.warp import enlarge
from methods.steernerf_lean.observation import LeanObservation
from methods.steernerf_lean.options import LeanRendering
from methods.steernerf_lean.refinement import rays_of_cells, worst_cells
from methods.steernerf_lean.surface import surface_points


class LeanPipeline(Pipeline):
    """A field and a lean 2D renderer that together render frames, one after the other."""

    kept = Kept

    def remember(self, camera: Camera, buffer: Buffer, rendering: LeanRendering) -> None:
        """Render the frame that follows those in `buffer`: later frames read its picture."""
        self.render(camera, buffer, rendering, NullProbe())

    def select(
        self, buffer: Sequence[Cloud], view: View, rendering: LeanRendering, probe: Probe
    ) -> Sequence[Cloud]:
        """The preceding frame, if it shares enough with `view`."""
        if buffer and rendering.overlap:
            with probe.stage("feature_reprojection"):
                if overlap(buffer[0], view.full).item() < rendering.overlap:
                    buffer = ()
        return super().select(buffer, view, rendering, probe)

    def observe(
        self,
        frame: FeatureFrame,
        preceding: Sequence[Cloud],
        view: View,
        rendering: LeanRendering,
        probe: Probe,
        cells: Tensor | None = None,
    ) -> LeanObservation:
        """What the lean 2D renderer is shown.

        Args:
            cells: the cells to draw; None: `near` decides, and the host waits for a GPU.
        """
        if cells is None:
            cells = self.near(frame, rendering).flatten().nonzero().squeeze(1)
        scale, backend = view.scale, self.backend
        depth = enlarge(frame.depth.detach(), cells, scale, backend=backend)
        with probe.stage("surface"):
            surface = surface_points(self.field, depth, cells, view, scale, probe)
        history = None
        if preceding and isinstance(kept := preceding[0], Kept):
            history = kept.warped(depth, cells, view, backend)
        return LeanObservation(frame, self.background, cells, surface, history, backend)

    def near(self, frame: FeatureFrame, rendering: LeanRendering) -> Tensor:
        """Which cells are drawn, [h, w] bool: those near matter, or all."""
        seen = frame.alpha > 0
        return cells_near(seen) if rendering.skip.background else torch.ones_like(seen)

    def draw(
        self, shown: LeanObservation, view: View, rendering: LeanRendering, probe: Probe
    ) -> Tensor:
        """The picture [H, W, 3], with the cells of the largest estimated error as rendered by the
        field."""
        with probe.stage("renderer2d"):
            drawing = self.renderer([shown], probe)
            picture = drawing.pictures[0].clamp_(0, 1)
        if rendering.refined:
            with probe.stage("refinement"):
                cells = shown.cells[worst_cells(drawing.error, rendering.refined)]
                colours = self.refined(cells, view, rendering, probe)
                put_pixels(picture, cells, view.scale, colours)
        return picture

    def refined(self, cells: Tensor, view: View, rendering: LeanRendering, probe: Probe) -> Tensor:
        """Render the colours [n, s^2, 3] of `cells` [n] with a ray through each of their pixels."""
        rays = rays_of_cells(cells, view)
        probe.count("refined_rays", len(rays.origins), view.full.width * view.full.height)
        how, occupancy = rendering.refined_sampling, self.occupied(rendering)
        pixels = render_rays(self.field, rays, occupancy, probe, how).over(self.background)
        return pixels.values[:, :3].clamp_(0, 1).view(len(cells), view.scale**2, 3)

    def keep(self, frame: FeatureFrame, view: View, picture: Tensor) -> Kept:
        """The points of the frame, and its picture."""
        return Kept(**vars(Cloud.of(frame)), full=view.full, picture=picture)
