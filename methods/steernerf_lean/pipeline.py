"""One frame of the lean SteerNeRF: the steps in which it differs from the paper's `Pipeline`.

The 2D renderer is shown the preceding picture and the field at the surface of each pixel, but no
features of preceding frames. The field then renders the cells with the largest estimated error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from bench.cameras import cast
from bench.types import Camera, NullProbe, Probe, Rays
from methods.rendering.frame import FeatureFrame, render_rays
from methods.steernerf.buffer import Buffer, Cloud, Points
from methods.steernerf.pipeline import Pipeline, View
from methods.steernerf_lean.cells import cells_near, centres, put_pixels
from methods.steernerf_lean.kernels.warp import enlarge, warp
from methods.steernerf_lean.observation import Kept, LeanObservation, overlap, surface_points
from methods.steernerf_lean.options import LeanRendering


def worst_cells(error: Tensor, share: float) -> Tensor:
    """Indices of the `share` of N cells with the largest estimated `error` [N]."""
    return error.topk(math.ceil(share * len(error)), sorted=False).indices


def rays_of_cells(cells: Tensor, view: View) -> Rays:
    """Rays through all pixels of `cells` [n], cell by cell: n s^2 of them."""
    return cast(view.full, centres(cells, view.low.width, view.scale).flatten(0, 1))


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

    def reproject(self, preceding: Sequence[Cloud], view: View) -> Points:
        """No features of preceding frames are shown."""
        return super().reproject((), view)

    def observe(
        self,
        frame: FeatureFrame,
        preceding: Sequence[Cloud],
        view: View,
        rendering: LeanRendering,
        probe: Probe,
        cells: Tensor | None = None,
    ) -> LeanObservation:
        """What the lean 2D renderer is shown of the `cells` [N] to draw; None: `near` decides, and
        the host waits for a GPU."""
        if cells is None:
            cells = self.near(frame, rendering).flatten().nonzero().squeeze(1)
        depth = enlarge(frame.depth.detach(), cells, view.scale, backend=self.backend)
        with probe.stage("surface"):
            surface = surface_points(self.field, depth, cells, view, probe)
        history = None
        if preceding and isinstance(kept := preceding[0], Kept):
            into = depth, cells, view.full, view.scale
            history = warp(kept.picture, kept.full, *into, backend=self.backend)
        return LeanObservation(frame, self.background, cells, surface, history, self.backend)

    def near(self, frame: FeatureFrame, rendering: LeanRendering) -> Tensor:
        """Which cells are drawn, [h, w] bool: those near matter, or all."""
        seen = frame.alpha > 0
        return cells_near(seen) if rendering.skip.background else torch.ones_like(seen)

    def draw(
        self, shown: LeanObservation, view: View, rendering: LeanRendering, probe: Probe
    ) -> Tensor:
        """The picture [H, W, 3]; the field renders the cells of the largest estimated error."""
        with probe.stage("renderer2d"):
            pictures, error = self.renderer([shown], probe)
            picture: Tensor = pictures[0].clamp_(0, 1)
        if rendering.refined:
            with probe.stage("refinement"):
                cells = shown.cells[worst_cells(error, rendering.refined)]
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
