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
from methods.steernerf.renderer import UNWATCHED, Renderer2d
from methods.steernerf_lean.cell_inputs import CellInputs, Layout
from methods.steernerf_lean.cell_network import CellNetwork
from methods.steernerf_lean.cells import number, paint
from methods.steernerf_lean.kernels.depthwise import neighbours_of
from methods.steernerf_lean.observation import Drawing, LeanObservation

PRETRAINED = Path(__file__).parent / "weights" / "lean.safetensors"
"""Weights trained on other scenes, by `steerbench pretrain`."""

PRETRAINED_LAYOUT = Layout(channels=3, scale=4, history=True)
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
        scale: s.
        history: whether to use the preceding picture.
        width: channels of the trunk.
        blocks: residual blocks of the trunk.
        init: "pretrained": start from the weights that come with the package, trained on other
            scenes; "scratch": from random ones.
    """

    network: CellNetwork

    def __init__(
        self,
        channels: int,
        scale: int,
        *,
        history: bool,
        width: int,
        blocks: int,
        init: Literal["pretrained", "scratch"],
    ) -> None:
        super().__init__()
        check_size("renderer.width", width, 1, 4096)
        check_size("renderer.blocks", blocks, 0, 256)
        self.layout = Layout(channels, scale, history)
        self.network = CellNetwork(self.layout, width, blocks)
        if init == "pretrained":
            self._start_from(load_file(PRETRAINED))

    def forward(self, observations: Sequence[LeanObservation], probe: Probe = UNWATCHED) -> Drawing:
        """Draw all observations; the estimated errors are those of their cells."""
        for o in observations:
            probe.count("cells", len(o.cells), o.frame.alpha.numel())
        inputs = CellInputs.of(observations, self.layout)
        rows, neighbours = inputs.rows(), self._neighbours(observations)
        # The matrix library prepares code for every new size, which takes longer than the product
        # itself. Rows of 0 round the size up, so that it sees few different ones.
        count = len(rows)
        surplus = (0, 0, 0, -count % self.network.quantum)
        rows = functional.pad(rows, surplus)
        neighbours = functional.pad(neighbours, surplus, value=-1)
        self.network.backend = observations[0].backend
        outputs = self.run(probe, rows, neighbours)
        output, error, matrix = (x[:count].to(inputs.base) for x in outputs)
        drawn = inputs.drawn(output, matrix)
        return Drawing(self._paint(observations, drawn), error[:, 0])

    def _neighbours(self, observations: Sequence[LeanObservation]) -> Tensor:
        """The neighbours [N, 9] of all cells."""
        size, device = observations[0].frame.alpha.shape, observations[0].cells.device
        active = torch.zeros(len(observations), *size, dtype=torch.bool, device=device)
        cells = number([o.cells for o in observations], size)
        active.view(-1).index_fill_(0, cells, True)
        return neighbours_of(active, len(cells))

    def _paint(self, observations: Sequence[LeanObservation], less: Tensor) -> Tensor:
        """Pictures [B, H, W, 3] from the pixels `less` [N, s^2, 3] of all cells, relative to the
        background."""
        size, background = observations[0].frame.alpha.shape, observations[0].background[:3]
        shown = [o.cells for o in observations]
        pixels = less.flatten(1) + background.repeat(self.layout.scale**2)  # a cell at a time
        return paint(shown, size, self.layout.scale, pixels.view_as(less), background)

    @torch.no_grad()
    def _start_from(self, pretrained: Mapping[str, Tensor]) -> None:
        """Copy the weights of a renderer with the same trunk that was trained at K = 3.

        Weights for features beyond RGB stay as they are.

        Raises:
            ValueError: this renderer has another shape.
        """
        try:
            known = PRETRAINED_LAYOUT.split(pretrained["enter.weight"])
            for name, weight in self.network.named_parameters():
                new = pretrained[name]
                if name == "enter.weight":
                    for part, columns in self.layout.split(weight).items():
                        if not part.endswith("rest"):
                            columns.copy_(known[part])
                elif name.startswith("read"):
                    weight.unflatten(0, (3, -1))[:, :4] = new.unflatten(0, (3, 4))
                else:
                    weight.copy_(new[: len(weight)] if name.startswith("leave") else new)
            if more := pretrained.keys() - self.network.state_dict().keys():
                raise KeyError(*more)
        except (KeyError, RuntimeError) as error:
            raise ValueError(
                "renderer.init=pretrained: those weights are of a renderer of the default "
                f"scale, width and blocks ({error}): use renderer.init=scratch"
            ) from error
