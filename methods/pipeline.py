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
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, place_camera, unproject
from bench.types import Camera, Frame, Probe
from methods.buffer import Cloud, Remembered, RenderingBuffer, Reprojection
from methods.cells import centres, put_pixels
from methods.fields import HashField
from methods.kernels.composite import STOP, check_stop
from methods.kernels.encode import HashGrid
from methods.kernels.march import Occupancy
from methods.kernels.warp import enlarge, warp
from methods.occupancy import STEP
from methods.range_reduction import RangeReduction, depths_around, evidence, render_guided
from methods.refresh import Refresh, first_ages, known_pixels
from methods.renderer2d import (
    Detail,
    Observation,
    Points,
    Renderer2d,
    cells_at_matter,
    check_refined,
    check_size,
)
from methods.rounds import render_rays
from methods.view import View
from methods.volume import FeatureFrame, query

SIZES = {"channels": (3, 256), "frames": (0, 64), "scale": (1, 64)}
"""K, L and s that a pipeline may have: from, to."""

LAYER = 4 * STEP
"""Thickness, in scene units, of what a single sample of the surface stands for."""


@dataclass(frozen=True)
class Skips:
    """What is not computed because no picture shows it; switched off, to see what that saves.

    Attributes:
        empty: samples where the field holds nothing, and rays that meet nothing else.
        hidden: samples behind a transmittance of `PipelineOptions.stop`.
        background: cells near which nothing is seen.
    """

    empty: bool = True
    hidden: bool = True
    background: bool = True


@dataclass(frozen=True)
class PipelineOptions:
    """What a frame is made of.

    Attributes:
        channels: K, features of the field; the first three are RGB.
        frames: L, preceding frames.
        scale: s, the field is rendered at 1/s of the resolution.
        range: where rays look for a surface. It is not trained for, and can be chosen afterwards.
        refresh: which low-resolution rays are not rendered anew. It is not trained for, either.
        reprojection: how preceding frames are brought into the present view.
        history: the preceding picture is reprojected, too.
        surface: the field is looked at once a pixel at full resolution, too, where the
            low-resolution depth has the surface.
        overlap: a preceding frame of which the present view shares less than this is not brought
            into it, neither its features nor its depth or picture; see `Cloud.overlap`. It can be
            chosen after the training.
        jitter: the samples of the low-resolution grid move from frame to frame, so that
            preceding frames carry samples of other places.
        feature_background: what the features beyond RGB are composited on. 1/2 is what an
            untrained feature is everywhere.
        stop: transmittance at which a ray ends.
        steps: length of a ray-marching step at low resolution, in those of stage 1: stage 2 teaches
            the field to do with longer ones.
        levels: of the field's grid that low-resolution rays read, the coarsest first: cells of the
            others may be far smaller than their pixels. None: all.
        refined: share of the cells whose pixels are rendered by the field after all, those that
            the 2D renderer doubts most. It can be chosen after the training, too.
        refined_steps: length of a ray-marching step there. It can be chosen after the training,
            which takes steps as short as those of stage 1: at full resolution longer ones show.
        skip: what is not computed. Nor is it trained for.
    """

    channels: int = 6
    frames: int = 2
    scale: int = 4
    range: RangeReduction = RangeReduction("off")
    refresh: Refresh = Refresh()
    reprojection: Reprojection = Reprojection()
    history: bool = True
    surface: bool = True
    overlap: float = 0.0
    jitter: bool = False
    feature_background: float = 0.5
    stop: float = STOP
    steps: float = 1.0
    levels: int | None = None
    refined: float = 0.0
    refined_steps: float = 1.0
    skip: Skips = Skips()

    def __post_init__(self) -> None:
        for name, (least, most) in SIZES.items():
            check_size(name, getattr(self, name), least, most)
        for name in ("steps", "refined_steps"):
            if not (length := getattr(self, name)) > 0:
                raise ValueError(f"{name}: expected a length of more than 0, got {length}")
        for name in ("overlap", "refined"):
            if not 0 <= (share := getattr(self, name)) <= 1:
                raise ValueError(f"{name}: expected a share of 0 to 1, got {share}")
        check_stop(self.stop)
        if not self.frames and self.range.mode != "off":
            raise ValueError(
                f"range.mode: expected off without preceding frames (L = 0), got {self.range.mode}"
            )
        if self.refresh.age and (not self.frames or self.reprojection != Reprojection()):
            raise ValueError(
                "refresh.age: expected 0 without preceding frames (L = 0) or with an inexact "
                f"reprojection, got {self.refresh.age}"
            )

    def check(self, grid: HashGrid, renderer: Renderer2d) -> None:
        """Refuse, with a ValueError, what a field of `grid` or the `renderer` cannot do."""
        if self.levels is not None:
            grid.check_levels(self.levels)
        check_refined("pipeline.refined", self.refined, renderer)
        if self.jitter and not renderer.shifts:
            raise ValueError(
                f"pipeline.jitter: {type(renderer).__name__} takes every sample for the middle of "
                "its cell, expected false, got true"
            )

    def taught(self, refined: float) -> PipelineOptions:
        """The options of a training. It looks everywhere, so that one serves all choices of where
        to look that are made afterwards."""
        off = RangeReduction("off")
        return replace(
            self,
            range=off,
            refresh=Refresh(),
            overlap=0.0,
            refined=refined,
            refined_steps=1.0,
            skip=Skips(),
        )


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

    @torch.no_grad()
    def render(self, camera: Camera, buffer: RenderingBuffer, probe: Probe) -> Frame:
        """Render one frame that follows those in `buffer`, and remember it there."""
        options, view = self.options, self.view(camera, buffer.turn)
        frames = self.shared(buffer.frames, view, probe)
        newest = frames[0] if frames else None
        features, age = self._features(view, newest, probe)
        with probe.stage("feature_reprojection"):
            preceding = [self.reproject(frame.cloud, view) for frame in frames]
            observation = self.observe(features, preceding, newest, view, probe)
        with probe.stage("renderer2d"):
            drawing = self.renderer([observation], probe)
            picture = drawing.pictures[0].clamp_(0, 1)
        if options.refined and drawing.doubt is not None:
            with probe.stage("refinement"):
                worst = observation.cells[most_doubted(drawing.doubt, options.refined)]
                colours = self.refine(worst, features, view, probe).clamp_(0, 1)
                put_pixels(picture, worst, options.scale, colours)
        with probe.stage("finish"):
            cloud = Cloud.of(features, options.reprojection, age)
            buffer.push(Remembered(cloud, view.full, picture))
            return _finish(camera, picture, features, options.scale)

    def shared(
        self, frames: Sequence[Remembered], view: View, probe: Probe
    ) -> Sequence[Remembered]:
        """Those of the preceding `frames` that show enough of what is in `view`."""
        if least := self.options.overlap:
            with probe.stage("feature_reprojection"):
                frames = [frame for frame in frames if frame.cloud.overlap(view.full) >= least]
        probe.count("preceding_frames", len(frames), self.options.frames)
        return frames

    def reproject(self, cloud: Cloud, view: View) -> Points:
        """The features of a preceding frame where the present picture sees them."""
        index, _ = cloud.land(view.full, self.options.reprojection, self.backend)
        return Points(cloud.values, index)

    def observe(
        self,
        frame: FeatureFrame,
        preceding: Sequence[Points],
        newest: Remembered | None,
        view: View,
        probe: Probe,
    ) -> Observation:
        """All that is known of the picture of `view` from its `frame` and the `preceding` ones."""
        options = self.options
        if options.skip.background:
            cells = cells_at_matter(frame.alpha, preceding)
        else:
            cells = torch.arange(frame.alpha.numel(), device=frame.alpha.device)
        probe.count("cells", len(cells), frame.alpha.numel())
        history = surface = None
        if options.history or options.surface:
            depth = enlarge(
                frame.depth.detach(), cells, options.scale, view.phase, backend=self.backend
            )
            history = self.history(newest, depth, cells, view)
            surface = self.surface(depth, cells, view, probe)
        return Observation(
            frame, self.background, preceding, cells, history, surface, view.phase, self.backend
        )

    def history(
        self, newest: Remembered | None, depth: Tensor, cells: Tensor, view: View
    ) -> Detail | None:
        """The preceding picture where the present one, of `depth` [N, s^2] in `cells`, sees it."""
        if newest is None or not self.options.history:
            return None
        scale, backend = self.options.scale, self.backend
        values, valid = warp(
            newest.picture, newest.camera, depth, cells, view.full, scale, backend=backend
        )
        return Detail(values, valid)

    def surface(self, depth: Tensor, cells: Tensor, view: View, probe: Probe) -> Points | None:
        """Features and, as the last of [P, K + 1], opacity of a sample at every pixel of `cells`
        whose `depth` [N, s^2] is finite, standing for a layer of `LAYER`.

        Differentiable in the field, not in its depth.
        """
        if not self.options.surface:
            return None
        with probe.stage("surface"):
            scale, width = self.options.scale, view.low.width
            known = depth.isfinite().flatten().nonzero().squeeze(1)
            pixels = centres(cells, width, scale).flatten(0, 1)[known]
            points = unproject(view.full, pixels, depth.flatten()[known])
            probe.count("surface_samples", len(points), view.full.width * view.full.height)
            self.field.count(probe, len(points), len(points))
            # The pixels of a cell share the view direction of its middle.
            middles = cast(view.low, centres(cells, width, 1)[:, 0]).directions
            sigma, values = query(self.field, points, known // scale**2, middles)
            alpha = -torch.expm1(-LAYER * sigma)
            index = torch.full(depth.shape, -1, dtype=torch.int32, device=depth.device)
            number = torch.arange(len(points), dtype=torch.int32, device=depth.device)
            index.view(-1)[known] = number
        return Points(torch.cat((values, alpha[:, None]), dim=1), index)

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
        self, view: View, newest: Remembered | None, probe: Probe
    ) -> tuple[FeatureFrame, Tensor | None]:
        """The field at low resolution, looked at where the newest preceding frame says and what it
        shows does not suffice; and the ages of the pixels."""
        options, found, known = self.options, None, None
        how = options.reprojection, self.backend
        if newest is not None:
            with probe.stage("depth_reprojection"):
                if options.range.mode != "off":
                    found = evidence(newest.cloud, view.low, options.range, *how)
                if options.refresh.age:
                    known = known_pixels(newest.cloud, view.low, options.refresh, *how)
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
            return known.put(features), known.ages(view.low)
        ages = first_ages(view.low, options.refresh, self.background.device)
        return features, ages if options.refresh.age else None


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
