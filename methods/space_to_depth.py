"""A lean 2D renderer that works at low resolution, where something is, and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from methods.cells import number, paint
from methods.kernels.depthwise import TAPS, depthwise, neighbours_of
from methods.kernels.lift import Layout, draw, lift
from methods.renderer2d import Drawing, Observation, Renderer2d

LEAK = 0.1
"""Slope of the activations below 0. With a slope of 0 the sparse inputs kill a trunk for good."""

QUANTUM = 256
"""The trunk is given cells in multiples of this."""

GENERIC = Path(__file__).parent / "weights" / "generic.safetensors"
"""Weights trained on other scenes, by `steerbench generic`."""

GENERIC_GROUPS = (
    ("present", 1, 4),
    ("preceding 0", 16, 4),
    ("preceding 1", 16, 4),
    ("history", 16, 4),
    ("surface", 16, 4),
)
"""What those weights expect: K = 3, L = 2, s = 4."""

GENERIC_SCALE = 4


Groups = Sequence[tuple[str, int, int]]


class SpaceToDepth(Renderer2d):
    """A network on cells: the s x s pixels of a low-resolution pixel are channels of its cell.

    A picture is the aligned bilinear enlargement of the present RGB (the base), blended pixel by
    pixel with the preceding picture where that is known, plus a correction, plus what the features
    at the surface of each pixel say, read by a matrix that all pixels of a cell share. Shares,
    corrections and matrices come from a trunk of depthwise 3 x 3 convolutions and matrix products,
    after ConvNeXt (Liu et al. 2022); so does the error to be expected in the cell.

    Only the cells of an observation are drawn; all others are background, and 0 to their
    neighbours. So nothing is computed for them, and a part of a frame is drawn exactly as in the
    whole. All features enter less their background, so that nothing is 0.

    Args:
        channels: K.
        frames: L.
        scale: s.
        width: channels of the trunk.
        blocks: residual blocks of the trunk.
        init: "generic": start from the weights that come with the package, trained on other
            scenes; "scratch": from random ones.
        history: use the preceding picture.
        surface: use the features at the surface, pixel by pixel.
    """

    doubts = True

    def __init__(
        self,
        channels: int,
        frames: int,
        scale: int,
        *,
        width: int = 64,
        blocks: int = 6,
        init: Literal["generic", "scratch"] = "generic",
        history: bool = True,
        surface: bool = True,
    ) -> None:
        super().__init__()
        self.channels, self.frames, self.scale = channels, frames, scale
        layout = self.layout = Layout(channels, frames, scale, history and frames > 0, surface)
        self.enter = _Linear(layout.width, width)
        self.trunk = nn.ModuleList(_Block(width) for _ in range(blocks))
        self.leave = _Linear(width, scale**2 * (3 + layout.history))
        self.read = _Linear(width, 3 * (channels + 1)) if surface else None
        self.doubt = _Linear(width, 1)
        for layer in filter(None, (self.leave, self.read, self.doubt)):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        if init == "generic":
            self._start_from(load_file(GENERIC))

    def forward(self, observations: Sequence[Observation]) -> Drawing:
        """See `Renderer2d`."""
        base, rows = self._lift(observations)
        hidden, backend = self._think(rows, observations), observations[0].backend
        matrix = None if self.read is None else self.read(hidden).to(base)
        drawn = draw(base, rows, self.leave(hidden).to(base), matrix, self.layout, backend=backend)
        doubt = self.doubt(hidden).to(base)[: len(base), 0]
        return Drawing(self._paint(observations, drawn), doubt)

    def base(self, observations: Sequence[Observation]) -> Tensor:
        """See `Renderer2d`."""
        return self._paint(observations, self._lift(observations)[0])

    def _lift(self, observations: Sequence[Observation]) -> tuple[Tensor, Tensor]:
        """The base and the rows of all their cells, rows of 0 behind them; see `lift`.

        The library behind the products prepares code for every new size, which takes longer than
        the product itself: it sees few sizes.
        """
        alone = len(observations) == 1
        parts = [self._lift_one(o, QUANTUM if alone else 1) for o in observations]
        if alone:
            return parts[0]
        base, rows = (torch.cat(some) for some in zip(*parts, strict=True))
        return base, functional.pad(rows, (0, 0, 0, -len(rows) % QUANTUM))

    def _lift_one(self, observation: Observation, multiple: int) -> tuple[Tensor, Tensor]:
        o, layout = observation, self.layout
        history = surface = None
        if o.history is not None and layout.history:
            history = o.history.values, o.history.valid
        if o.surface is not None and layout.surface:
            surface = o.surface.values, o.surface.index
        return lift(
            o.frame.values,
            o.frame.alpha,
            o.background,
            o.cells,
            [(points.values, points.index) for points in o.preceding],
            history,
            surface,
            layout,
            o.phase,
            multiple=multiple,
            backend=o.backend,
        )

    def _think(self, rows: Tensor, observations: Sequence[Observation]) -> Tensor:
        """The trunk on `rows`, of all cells and some more: [R, width]."""
        neighbours, backend = self._neighbours(observations), observations[0].backend
        neighbours = functional.pad(neighbours, (0, 0, 0, len(rows) - len(neighbours)), value=-1)
        hidden = self.enter(rows).to(rows)
        for block in self.trunk:
            hidden = block(hidden, neighbours, backend)
        return functional.leaky_relu(hidden, LEAK)

    def _neighbours(self, observations: Sequence[Observation]) -> Tensor:
        height, width = observations[0].frame.alpha.shape
        batch, device = len(observations), observations[0].cells.device
        active = torch.zeros(batch * height * width, dtype=torch.bool, device=device)
        active[number([o.cells for o in observations], observations[0].frame.alpha.shape)] = True
        return neighbours_of(active.view(batch, height, width))

    def _paint(self, observations: Sequence[Observation], less: Tensor) -> Tensor:
        """Pictures [B, H, W, 3] of all cells, of which `less` [N, s^2, 3] has no background."""
        size, background = observations[0].frame.alpha.shape, observations[0].background[:3]
        shown = [o.cells for o in observations]
        return paint(shown, size, self.scale, less + background, background)

    @torch.no_grad()
    def _start_from(self, generic: Mapping[str, Tensor]) -> None:
        """Take over the weights of a renderer of the same trunk that was trained at K = 3, L = 2.

        Weights of features beyond RGB, and of frames it did not have, stay as they are.

        Raises:
            ValueError: this renderer is of another shape.
        """
        weights = dict(self.named_parameters())
        unused = {name for name in generic if name.startswith("read") and not self.layout.surface}
        ours, theirs = _same_columns(self.layout.groups, GENERIC_GROUPS)
        slots = range(self.scale**2)
        written = [4 * slot + i for slot in slots for i in range(3 + self.layout.history)]
        matrix = [(self.channels + 1) * row + column for row in range(3) for column in range(4)]
        try:
            if weights.keys() != generic.keys() - unused or self.scale != GENERIC_SCALE:
                raise RuntimeError("other layers, or another scale")
            for name, weight in weights.items():
                new = generic[name].float()
                if name == "enter.weight":
                    weight[:, ours] = new[:, theirs]
                elif name.startswith("read"):
                    weight[matrix] = new
                else:
                    weight.copy_(new[written] if name.startswith("leave") else new)
        except RuntimeError as error:
            raise ValueError(
                "renderer.init=generic: the weights are those of a renderer of the default scale, "
                f"width and blocks ({error}): use renderer.init=scratch"
            ) from error


def _same_columns(ours: Groups, theirs: Groups) -> tuple[list[int], list[int]]:
    """Columns of colours and validity that two layouts of the inputs have in common."""
    columns: tuple[dict[tuple[str, int, int], int], ...] = ({}, {})
    for groups, place in zip((ours, theirs), columns, strict=True):
        begin = 0
        for name, slots, features in groups:
            for slot in range(slots):
                for feature in range(min(features, 4)):
                    place[name, slot, feature] = begin + slot * features + feature
            begin += slots * features
    both = [key for key in columns[0] if key in columns[1]]
    return [columns[0][key] for key in both], [columns[1][key] for key in both]


class _Linear(nn.Linear):
    def forward(self, x: Tensor) -> Tensor:
        return _product(x, self.weight, self.bias)


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """x W^T + b of `x` [N, C] and `weight` [D, C].

    Without gradient, a convolution of 1 x 1: torch hands products of float32 to MKL and
    convolutions to oneDNN, which is twice as fast on processors that are not Intel's.
    """
    if torch.is_grad_enabled() or not len(x):
        return functional.linear(x, weight, bias)
    picture = x[None, :, None].permute(0, 3, 1, 2)  # [1, C, N, 1], the channels last in memory
    return functional.conv2d(picture, weight[:, :, None, None], bias)[0, :, :, 0].T


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
