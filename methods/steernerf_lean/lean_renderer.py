"""A lean 2D renderer that works at low resolution, and only on cells near matter, with a network
after ConvNeXt (Liu et al. 2022)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe
from methods.engines.network import Network
from methods.kernels.types import expect
from methods.steernerf.unet import UNWATCHED, Renderer2d
from methods.steernerf_lean.cell_inputs import CellInputs, Layout
from methods.steernerf_lean.cells import number, paint
from methods.steernerf_lean.kernels.depthwise import TAPS, depthwise, neighbours_of
from methods.steernerf_lean.observation import LeanObservation

PRETRAINED = Path(__file__).parent / "weights" / "lean.safetensors"
"""Weights trained on other scenes, by `steerbench pretrain`."""

PRETRAINED_LAYOUT = Layout(channels=3, scale=4, history=True)  # of their inputs

LEAK = 0.1
"""Slope of the activations below 0. With plain ReLU, units die on the sparse inputs and never
recover."""


class CellNetwork(Network):
    """A trunk of depthwise 3 x 3 convolutions and matrix products, of `width` channels and so many
    residual `blocks`, with one head for each output. `layout` is that of the input rows."""

    varying = True  # cells
    quantum = 512

    def __init__(self, layout: Layout, width: int, blocks: int) -> None:
        super().__init__()
        self.enter = _Linear(layout.width, width)
        self.trunk = nn.ModuleList(_Block(width) for _ in range(blocks))
        self.leave = _Linear(width, layout.scale**2 * (3 + layout.history))
        self.error = _Linear(width, 1)
        self.read = _Linear(width, 3 * (layout.channels + 1))
        for layer in (self.leave, self.error, self.read):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, rows: Tensor, neighbours: Tensor) -> tuple[Tensor, ...]:
        """Corrections and logits of the shares [N, (3 + layout.history) s^2]; estimated error
        [N, 1], the log of the mean squared error; matrices [N, 3 (K + 1)]: of cells with the `rows`
        [N, layout.width] and the `neighbours` [N, 9]."""
        hidden = self.enter(rows).to(rows)
        for block in self.trunk:
            hidden = block(hidden, neighbours, self.backend)
        hidden = functional.leaky_relu(hidden, LEAK)
        return self.leave(hidden), self.error(hidden), self.read(hidden)

    def products(self, *inputs: Tensor) -> int:
        """Every matrix, and the taps of every channel, count once per cell."""
        return len(inputs[0]) * sum(x.numel() for x in self.parameters() if x.dim() > 1)


class _Linear(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        """x W^T + b of `x` [N, C]. Without gradient it is a 1 x 1 convolution: torch hands products
        of float32 to MKL, but convolutions to oneDNN, twice as fast on non-Intel processors."""
        if torch.is_grad_enabled() or torch.jit.is_tracing() or not len(x):
            return super().forward(x)
        picture = x[None, :, None].permute(0, 3, 1, 2)  # [1, C, N, 1], channels last in memory
        return functional.conv2d(picture, self.weight[:, :, None, None], self.bias)[0, :, :, 0].T


class _Block(nn.Module):
    """x + W2 act(W1 (x convolved channel by channel))."""

    def __init__(self, width: int, growth: int = 2) -> None:
        super().__init__()
        self.spread = nn.Parameter(torch.randn(TAPS, width) / 3)
        self.grow = _Linear(width, growth * width)
        self.shrink = _Linear(growth * width, width)
        with torch.no_grad():
            self.shrink.weight.mul_(0.1)

    def forward(self, x: Tensor, neighbours: Tensor, backend: str) -> Tensor:
        """`x` [N, width] of cells with `neighbours` [N, 9]."""
        mixed = depthwise(x, neighbours, self.spread, backend=backend)
        grown = functional.leaky_relu(self.grow(mixed), LEAK, inplace=not torch.is_grad_enabled())
        return x + self.shrink(grown)


class Drawing(NamedTuple):
    """What the lean 2D renderer gives."""

    pictures: Tensor  # [B, H, W, 3]
    error: Tensor  # [N] estimated log of the mean squared error of each cell, picture by picture


class LeanRenderer(Renderer2d):
    """A network on cells: the s x s pixels of a low-resolution pixel are channels of its cell.

    A picture starts from the base: the present RGB, bilinearly enlarged with every pixel in its
    place. Each of its pixels is blended with the preceding picture where that is known. Then a
    correction is added, and the features at the surface of the pixel times a matrix that all pixels
    of a cell share. The network gives shares, corrections, matrices, and the error to expect.

    Only the cells of an observation are drawn; all others are background, and 0 to their
    neighbours: a part of a frame is drawn exactly as in the whole, but for the cells near the cut.

    `channels`, `frames`, `scale` are K, L (1: the preceding picture is used), s; `width` and
    `blocks` those of the network; `init` "pretrained" starts from the weights that come with the
    package, "scratch" from random ones.
    """

    network: CellNetwork

    def __init__(
        self,
        channels: int,
        frames: int,
        scale: int,
        *,
        width: int,
        blocks: int,
        init: Literal["pretrained", "scratch"],
    ) -> None:
        super().__init__()
        expect(0 <= frames <= 1, "model.frames", "0 to 1", frames)
        expect(1 <= width <= 4096, "renderer.width", "1 to 4096", width)
        expect(0 <= blocks <= 256, "renderer.blocks", "0 to 256", blocks)
        self.layout = Layout(channels, scale, history=frames > 0)
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
        """Copy the weights of a renderer with the same trunk that was trained at K = 3; those for
        features beyond RGB stay as they are. Raises ValueError if this one has another shape."""
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
