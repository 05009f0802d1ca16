"""Rendering of a frame: what is baked for it, and what it costs (Wu et al. 2022, Section 3.4)."""

from __future__ import annotations

from typing import Literal

import torch
from torch.nn import functional

from bench.types import Probe, Rays
from methods.diver.kernels.segments import Corners, Layers, render_segments
from methods.diver.model import CHANNELS, DIRECTION_CHANNELS, CornerModel, encode_directions
from methods.kernels.corner_gather import CORNERS
from methods.kernels.types import Occupancy, Pixels
from methods.rendering.compaction import to_host

Stored = Literal["bf16", "fp32"]


class Baked:
    """A trained model as it is rendered, with features of the corners in the type `stored`.

    Integration is linear and its weights add up to 1, so the first layer of the decoder may come
    before it: it is already applied to the corners. No ReLU separates the 32 outputs of the third
    layer from the layer of the directions: the two are merged.
    """

    @torch.no_grad()
    def __init__(self, model: CornerModel, stored: Stored) -> None:
        decoder = model.decoder
        table = functional.linear(model.table, decoder.first.weight, decoder.first.bias)
        table = table.to(torch.bfloat16 if stored == "bf16" else torch.float32)
        self.corners, self.backend = Corners(model.voxels, model.corners, table), model.backend
        self.occupancy = Occupancy.at(model.voxels.coordinates, model.resolution)
        along, across = decoder.view.weight.split((CHANNELS, DIRECTION_CHANNELS), dim=1)
        third, bias = decoder.third.weight, decoder.third.bias
        self.layers = Layers(
            hidden=decoder.second.weight.detach(),
            hidden_bias=decoder.second.bias.detach(),
            density=third[:1],
            density_bias=bias[:1],
            geometry=along @ third[1:],
            colour=decoder.colour.weight.detach(),
            colour_bias=decoder.colour.bias.detach(),
        )
        self.across, self.view_bias = across.clone(), decoder.view.bias + along @ bias[1:]

    def sizes(self) -> dict[str, int]:
        """Bytes of the features, of a bit per cell that marks voxels, and of the decoder."""
        decoder = (*vars(self.layers).values(), self.across, self.view_bias)
        return {
            "corners": self.corners.table.numel() * self.corners.table.element_size(),
            "voxels": self.occupancy.cells.numel() // 8,
            "decoder": 4 * sum(part.numel() for part in decoder),
        }

    @torch.no_grad()
    def render_rays(self, rays: Rays, probe: Probe, stop: float, faint: float) -> Pixels:
        """Render R `rays`, not composited on a background.

        Args:
            stop: transmittance at which a ray ends.
            faint: weight below which a segment has an opacity but no colour.
        """
        layers = self.layers
        with probe.stage("segments"):
            encoded = encode_directions(rays.directions)
            towards = functional.linear(encoded, self.across, self.view_bias)
            given, how = (rays, self.corners, layers, towards), {"stop": stop, "faint": faint}
            pixels, crossed, shaded = render_segments(*given, **how, backend=self.backend)
        segments, colours = map(int, to_host([crossed.sum(), shaded.sum()]))
        probe.count("segments", segments)
        probe.count("shaded_segments", colours, segments)
        probe.count("table_reads", CORNERS * segments)
        density = layers.hidden.numel() + layers.density.numel()
        colour = layers.geometry.numel() + layers.colour.numel()
        directions = self.across.numel() * len(rays.origins)
        probe.count("products", segments * density + colours * colour + directions)
        return pixels
