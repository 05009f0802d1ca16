"""Rendering of a frame: what is baked for it, and what it costs (Wu et al. 2022, Section 3.4)."""

from __future__ import annotations

from typing import Literal

import torch
from torch.nn import functional

from bench.types import Probe, Rays
from methods.diver.decoder import Merged
from methods.diver.kernels.segments import Corners, render_segments
from methods.diver.model import CornerModel
from methods.kernels.corner_gather import CORNERS
from methods.kernels.types import Occupancy, Pixels
from methods.rendering.compaction import to_host

Stored = Literal["bf16", "fp32"]


class Baked:
    """A trained model as it is rendered: the first layer of the decoder is already applied to the
    corners, and its layers around the direction are merged.

    Args:
        model: the trained model.
        stored: type of the corners' features.
    """

    @torch.no_grad()
    def __init__(self, model: CornerModel, stored: Stored) -> None:
        first = model.decoder.first
        table = functional.linear(model.table, first.weight, first.bias)
        table = table.to(torch.bfloat16 if stored == "bf16" else torch.float32)
        self.corners = Corners(model.corners, table)
        self.model, self.merged = model, Merged.of(model.decoder)
        self.occupancy = Occupancy.at(model.voxels.coordinates, model.resolution)

    def sizes(self) -> dict[str, int]:
        """Bytes of the features, of a bit per cell that marks voxels, and of the decoder."""
        return {
            "corners": self.corners.table.numel() * self.corners.table.element_size(),
            "voxels": self.occupancy.cells.numel() // 8,
            "decoder": 4 * self.merged.numel(),
        }

    @torch.no_grad()
    def render_rays(self, rays: Rays, probe: Probe, stop: float, faint: float) -> Pixels:
        """Render R `rays`, not composited on a background.

        Args:
            stop: transmittance at which a ray ends.
            faint: weight below which a segment has an opacity but no colour.
        """
        model, layers = self.model, self.merged.layers
        with probe.stage("segments"):
            pixels, crossed, shaded = render_segments(
                rays,
                model.voxels,
                self.corners,
                layers,
                self.merged.towards(rays.directions),
                stop=stop,
                faint=faint,
                backend=model.backend,
            )
        segments, colours = map(int, to_host([crossed.sum(), shaded.sum()]))
        probe.count("segments", segments)
        probe.count("shaded_segments", colours, segments)
        probe.count("table_reads", CORNERS * segments)
        density = layers.hidden.numel() + layers.density.numel()
        colour = layers.geometry.numel() + layers.colour.numel()
        directions = self.merged.across.numel() * len(rays.origins)
        probe.count("products", segments * density + colours * colour + directions)
        return pixels
