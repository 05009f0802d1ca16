"""A lean 2D renderer that works at low resolution, and only on cells near matter."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from bench.types import Probe
from methods.steernerf.options import check_size
from methods.steernerf.renderer import UNWATCHED, Drawing, Observation, Renderer2d
from methods.steernerf_lean.cell_network import CellNetwork
from methods.steernerf_lean.cells import number, paint
from methods.steernerf_lean.kernels.depthwise import neighbours_of
from methods.steernerf_lean.kernels.space_to_depth import (
    CellInputs,
    Layout,
    depth_to_space,
    space_to_depth,
)

PRETRAINED = Path(__file__).parent / "weights" / "lean.safetensors"
"""Weights trained on other scenes, by `steerbench pretrain`."""

PRETRAINED_LAYOUT = Layout(channels=3, frames=1, scale=4, history=True, surface=True)
"""The inputs that those weights expect."""


class LeanRenderer(Renderer2d):
    """A network on cells: the s x s pixels of a low-resolution pixel are channels of its cell.

    A picture starts from the base: the present RGB, bilinearly enlarged with every pixel in its
    place. Each of its pixels is blended with the preceding picture where that is known. Then a
    correction is added, and the features at the surface of the pixel times a matrix that all pixels
    of a cell share. The network gives the blending shares, corrections and matrices, and also the
    error to expect in each cell.

    Only the cells of an observation are drawn; all others are background, and 0 to their
    neighbours. So nothing is computed for them, and a part of a frame is drawn exactly as in the
    whole, but for the cells near the cut, whose neighbours are missing. The background is
    subtracted from all features, so that empty space is 0.

    Args:
        channels: K.
        frames: L.
        scale: s.
        width: channels of the trunk.
        blocks: residual blocks of the trunk.
        init: "pretrained": start from the weights that come with the package, trained on other
            scenes; "scratch": from random ones.
        history: whether to use the preceding picture.
        surface: whether to use the features at the surface of each pixel.
    """

    draws_cells = True
    estimates_error = True
    reads_details = True
    network: CellNetwork

    def __init__(
        self,
        channels: int,
        frames: int,
        scale: int,
        *,
        width: int = 64,
        blocks: int = 6,
        init: Literal["pretrained", "scratch"] = "pretrained",
        history: bool = True,
        surface: bool = True,
    ) -> None:
        super().__init__()
        check_size("renderer.width", width, 1, 4096)
        check_size("renderer.blocks", blocks, 0, 256)
        self.channels, self.frames, self.scale = channels, frames, scale
        layout = self.layout = Layout(channels, frames, scale, history and frames > 0, surface)
        self.network = CellNetwork(layout, width, blocks)
        if init == "pretrained":
            self._start_from(load_file(PRETRAINED))

    def forward(self, observations: Sequence[Observation], probe: Probe = UNWATCHED) -> Drawing:
        """See `Renderer2d`."""
        for o in observations:
            probe.count("cells", len(o.cells), o.frame.alpha.numel())
        base, rows = self._rows(observations)
        neighbours, backend = self._neighbours(observations, len(rows)), observations[0].backend
        self.network.backend = backend
        output, error, *matrix = (x.to(base) for x in self.run(probe, rows, neighbours))
        drawn = depth_to_space(
            base, rows, output, next(iter(matrix), None), self.layout, backend=backend
        )
        return Drawing(self._paint(observations, drawn), error[: len(base), 0])

    def base(self, observations: Sequence[Observation]) -> Tensor:
        """See `Renderer2d`."""
        alone = Layout(self.channels, 0, self.scale, history=False, surface=False)
        parts = [
            space_to_depth(
                CellInputs(o.frame.values, o.frame.alpha, o.background, o.cells),
                alone,
                backend=o.backend,
            )[0]
            for o in observations
        ]
        return self._paint(observations, torch.cat(parts))

    def _rows(self, observations: Sequence[Observation]) -> tuple[Tensor, Tensor]:
        """The base and the rows of all their cells, followed by rows of 0; see `space_to_depth`.

        The matrix library prepares code for every new size, which takes longer than the product
        itself. Rows of 0 round the size up, so that it sees few different ones.
        """
        alone = len(observations) == 1
        quantum = self.network.quantum
        parts = [self._cells_of(o, quantum if alone else 1) for o in observations]
        if alone:
            return parts[0]
        base, rows = (torch.cat(some) for some in zip(*parts, strict=True))
        return base, functional.pad(rows, (0, 0, 0, -len(rows) % quantum))

    def _cells_of(self, observation: Observation, multiple: int) -> tuple[Tensor, Tensor]:
        o, layout = observation, self.layout
        history = surface = None
        if o.history is not None and layout.history:
            history = o.history.values, o.history.valid
        if o.surface is not None and layout.surface:
            surface = o.surface.values, o.surface.index
        inputs = CellInputs(
            o.frame.values,
            o.frame.alpha,
            o.background,
            o.cells,
            [(points.values, points.index) for points in o.preceding],
            history,
            surface,
        )
        return space_to_depth(inputs, layout, multiple=multiple, backend=o.backend)

    def _neighbours(self, observations: Sequence[Observation], rows: int) -> Tensor:
        """The neighbours [R, 9] of all cells; rows without any follow, up to `rows`."""
        size, device = observations[0].frame.alpha.shape, observations[0].cells.device
        active = torch.zeros(len(observations), *size, dtype=torch.bool, device=device)
        cells = number([o.cells for o in observations], size)
        active.view(-1).index_fill_(0, cells, True)
        neighbours = neighbours_of(active, len(cells))
        return functional.pad(neighbours, (0, 0, 0, rows - len(neighbours)), value=-1)

    def _paint(self, observations: Sequence[Observation], less: Tensor) -> Tensor:
        """Pictures [B, H, W, 3] from the pixels `less` [N, s^2, 3] of all cells, relative to the
        background."""
        size, background = observations[0].frame.alpha.shape, observations[0].background[:3]
        shown = [o.cells for o in observations]
        pixels = less.flatten(1) + background.repeat(self.scale**2)  # a cell at a time
        return paint(shown, size, self.scale, pixels.view_as(less), background)

    @torch.no_grad()
    def _start_from(self, pretrained: Mapping[str, Tensor]) -> None:
        """Copy the weights of a renderer with the same trunk that was trained at K = 3, L = 1.

        Weights for features beyond RGB, and for frames that it did not have, stay as they are.

        Raises:
            ValueError: this renderer has another shape.
        """
        weights = dict(self.network.named_parameters())
        unused = {
            name for name in pretrained if name.startswith("read") and not self.layout.surface
        }
        ours, theirs = _same_columns(self.layout, PRETRAINED_LAYOUT)
        slots = range(self.scale**2)
        written = [4 * slot + i for slot in slots for i in range(3 + self.layout.history)]
        matrix = [(self.channels + 1) * row + column for row in range(3) for column in range(4)]
        try:
            same_layers = weights.keys() == pretrained.keys() - unused
            if not same_layers or self.scale != PRETRAINED_LAYOUT.scale:
                raise RuntimeError("other layers, or another scale")
            if (inputs := pretrained["enter.weight"].shape[1]) != PRETRAINED_LAYOUT.width:
                raise RuntimeError(f"{inputs} inputs instead of {PRETRAINED_LAYOUT.width}")
            for name, weight in weights.items():
                new = pretrained[name].float()
                if name == "enter.weight":
                    weight[:, ours] = new[:, theirs]
                elif name.startswith("read"):
                    weight[matrix] = new
                else:
                    weight.copy_(new[written] if name.startswith("leave") else new)
        except RuntimeError as error:
            raise ValueError(
                "renderer.init=pretrained: those weights are of a renderer of the default "
                f"scale, width and blocks ({error}): use renderer.init=scratch"
            ) from error


def _same_columns(ours: Layout, theirs: Layout) -> tuple[list[int], list[int]]:
    """The input columns of colours and validity that both layouts have, as indices into each."""
    mine, others = _columns(ours), _columns(theirs)
    both = [key for key in mine if key in others]
    return [mine[key] for key in both], [others[key] for key in both]


def _columns(layout: Layout) -> dict[tuple[str, int, int], int]:
    """The input columns of colours and validity, by group, slot and feature."""
    return {
        (name, slot, feature): layout.begins[name] + slot * features + feature
        for name, slots, features in layout.groups
        for slot in range(slots)
        for feature in range(min(features, 4))
    }
