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
        first, cells = observations[0], [o.cells for o in observations]
        size, background = first.frame.alpha.shape, first.background[:3]
        for some in cells:
            probe.count("cells", len(some), size.numel())
        inputs = CellInputs.of(observations, self.layout)
        rows = inputs.rows()
        drawn_at = torch.zeros(len(cells), *size, dtype=torch.bool, device=rows.device)
        drawn_at.view(-1).index_fill_(0, number(cells, size), True)
        neighbours = neighbours_of(drawn_at, len(rows))
        # The matrix library prepares code for every new size, which takes longer than the product
        # itself. Rows of 0 round the size up, so that it sees few different ones.
        surplus = (0, 0, 0, -len(rows) % self.network.quantum)
        rows, count = functional.pad(rows, surplus), len(rows)
        self.network.backend = first.backend
        outputs = self.run(probe, rows, functional.pad(neighbours, surplus, value=-1))
        output, error, matrix = (x[:count].to(inputs.base) for x in outputs)
        less = inputs.drawn(output, matrix).flatten(1)
        pixels = (less + background.repeat(self.layout.scale**2)).view_as(inputs.base)
        return Drawing(paint(cells, size, self.layout.scale, pixels, background), error[:, 0])

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
