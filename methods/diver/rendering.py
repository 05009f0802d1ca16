"""A frame: rays take a few segments at a time and end early (Wu et al. 2022, Section 3.4)."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Probe, Rays
from methods.diver.decoder import Merged, encode_directions
from methods.diver.model import CornerModel, as_intervals
from methods.kernels.composite import Pixels, composite, weights
from methods.kernels.corner_gather import gather
from methods.kernels.march import Occupancy
from methods.kernels.voxel_walk import Crossings, walk
from methods.rendering.field import pad

Stored = Literal["bf16", "fp32"]

CHUNK_RAYS = 1 << 16
"""Rays rendered together: enough to keep all threads busy, few enough to stay in the cache."""

ROUND_SEGMENTS = 6
"""Segments of a ray in a round; see `methods.rendering.rays`."""


class Baked:
    """A trained model as it is rendered: the decoder's first layer applied to the corners, and its
    layers around the direction merged.

    Args:
        model: what was trained.
        stored: type of the corners' features.
    """

    @torch.no_grad()
    def __init__(self, model: CornerModel, stored: Stored) -> None:
        first = model.decoder.first
        table = functional.linear(model.table, first.weight, first.bias)
        self.table = table.to(torch.bfloat16 if stored == "bf16" else torch.float32)
        self.model, self.decoder = model, Merged.of(model.decoder)
        self.occupancy = Occupancy.at(model.voxels.coordinates, model.resolution)

    def sizes(self) -> dict[str, int]:
        """Bytes of features, of a bit a cell that tells which are voxels, and of the decoder."""
        return {
            "corners": self.table.numel() * self.table.element_size(),
            "voxels": self.occupancy.cells.numel() // 8,
            "decoder": 4 * self.decoder.numel(),
        }

    @torch.no_grad()
    def render_rays(self, rays: Rays, probe: Probe, stop: float, faint: float) -> Pixels:
        """The pixels of `rays`, R of them, not composited on a background.

        Args:
            stop: transmittance at which a ray ends.
            faint: weight below which a segment has an opacity but no colour.
        """
        model, device = self.model, rays.origins.device
        canvas = Pixels.blank(len(rays.origins), 3, device)
        for first in range(0, len(rays.origins), CHUNK_RAYS):
            open_ = torch.arange(first, min(first + CHUNK_RAYS, len(rays.origins)), device=device)
            start = torch.zeros(len(open_), device=device)
            count = len(open_)
            while len(open_):
                with probe.stage("walk"):
                    some = rays.take(open_)
                    crossings = walk(
                        some,
                        model.voxels,
                        start=start,
                        limit=ROUND_SEGMENTS * max(count // (2 * len(open_)), 1),
                        backend=model.backend,
                    )
                probe.count("segments", len(crossings))
                if not len(crossings):
                    break
                front = canvas.take(open_)
                sigma, colours = self._evaluated(crossings, some, front, stop, faint, probe)
                with probe.stage("composite"):
                    pixels = composite(
                        sigma,
                        colours,
                        as_intervals(crossings),
                        stop=stop,
                        carry=front,
                        backend=model.backend,
                    )
                    canvas.put(open_, pixels)
                    left = crossings.resume.isfinite() & (1 - pixels.alpha > stop)
                    left = left.nonzero().squeeze(1)
                    open_, start = open_[left], crossings.resume[left]
        return canvas

    def _evaluated(
        self,
        crossings: Crossings,
        rays: Rays,
        front: Pixels,
        stop: float,
        faint: float,
        probe: Probe,
    ) -> tuple[Tensor, Tensor]:
        """Integrated densities [S] and colours [S, 3] behind what is in `front`; colours of faint
        segments are 0."""
        model, decoder, count = self.model, self.decoder, len(crossings)
        with probe.stage("gather"):
            weight = model.weights(rays, crossings)
            features = gather(
                self.table,
                model.corners,
                pad(crossings.voxel),
                pad(weight),
                backend=model.backend,
            )
        with probe.stage("decode"):
            hidden = functional.linear(features.relu_(), decoder.second, decoder.second_bias)
            hidden.relu_()
            sigma = functional.linear(hidden, decoder.sigma, decoder.sigma_bias).relu_()
            sigma = sigma.squeeze(1)[:count]
            weight = weights(
                sigma,
                as_intervals(crossings),
                stop=stop,
                front=1 - front.alpha,
                backend=model.backend,
            )
            seen = (weight > faint).nonzero().squeeze(1)
            index = pad(seen)
            encoded = encode_directions(rays.directions)
            towards = functional.linear(encoded, decoder.across, decoder.view_bias)
            shown = functional.linear(hidden[index], decoder.along) + towards[crossings.ray[index]]
            shown = functional.linear(shown.relu_(), decoder.colour, decoder.colour_bias).sigmoid()
            colours = sigma.new_zeros(count, 3)
            colours[seen] = shown[: len(seen)]
        probe.count("shaded_segments", len(seen), count)
        probe.count("table_reads", 8 * count)
        probe.count("products", self._products(count, len(seen), len(rays.origins)))
        return sigma, colours

    def _products(self, segments: int, shaded: int, rays: int) -> int:
        decoder = self.decoder
        return (
            segments * (decoder.second.numel() + decoder.sigma.numel())
            + shaded * (decoder.along.numel() + decoder.colour.numel())
            + rays * decoder.across.numel()
        )
