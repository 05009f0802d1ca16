"""A lean 2D renderer that works at low resolution, where something is, and nowhere else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torch.nn import functional

from methods.cells import number, paint, pixels_of
from methods.kernels.depthwise import TAPS, depthwise, neighbours_of
from methods.kernels.splat import gather
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
"""Inputs of a cell: name, slots, features a slot. A feature beyond the fourth is no colour."""


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
        self.history, self.surface = history and frames > 0, surface
        groups = self._input_groups()
        self.enter = _Linear(sum(slots * features for _, slots, features in groups), width)
        self.trunk = nn.ModuleList(_Block(width) for _ in range(blocks))
        self.leave = _Linear(width, scale**2 * (3 + self.history))
        self.read = _Linear(width, 3 * (channels + 1)) if surface else None
        self.doubt = _Linear(width, 1)
        for layer in filter(None, (self.leave, self.read, self.doubt)):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        if init == "generic":
            self._start_from(load_file(GENERIC))

    def _input_groups(self) -> Groups:
        """What a cell is given, in its order: colour, how far something is there, the rest."""
        cell, features = self.scale**2, self.channels + 1
        return [
            ("present", 1, features),
            *((f"preceding {age}", cell, features) for age in range(self.frames)),
            *[("history", cell, 4)] * self.history,
            *[("surface", cell, features)] * self.surface,
        ]

    def forward(self, observations: Sequence[Observation]) -> Drawing:
        """See `Renderer2d`."""
        parts = [self._inputs(o) for o in observations]
        base, *groups = (_join(some) for some in zip(*parts, strict=True))
        hidden = self._think([x.flatten(start_dim=1) for x in groups], observations)
        count = len(base)
        out = self.leave(hidden)[:count].to(base).view(-1, self.scale**2, 3 + self.history)
        drawn = base + out[..., :3]
        if self.history:
            recent, known = groups[1 + self.frames].split((3, 1), dim=-1)
            drawn = drawn + (out[..., 3:].sigmoid() * known) * recent
        if self.read is not None:
            detail = groups[-1]
            matrix = self.read(hidden)[:count].to(base).view(-1, 3, self.channels + 1)
            # The colour of what is hardly there counts little.
            weighed = torch.cat((detail[..., :3] * detail[..., 3:4], detail[..., 3:]), dim=-1)
            with torch.autocast(base.device.type, enabled=False):
                drawn = drawn + weighed @ matrix.transpose(1, 2)
        doubt = self.doubt(hidden)[:count].to(base).squeeze(1)
        return Drawing(self._paint(observations, drawn), doubt)

    def _think(self, inputs: Sequence[Tensor], observations: Sequence[Observation]) -> Tensor:
        """The trunk on the `inputs` of all cells, [N, width], and some rows more.

        The library behind the products prepares code for every new size, which takes longer than
        the product itself: it sees few sizes.
        """
        neighbours, backend = self._neighbours(observations), observations[0].backend
        count = len(neighbours)
        rows = max(-(-count // QUANTUM), 1) * QUANTUM
        if torch.is_grad_enabled():
            inputs = [functional.pad(x, (0, 0, 0, rows - count)) for x in inputs]
        hidden = self._enter(inputs).to(inputs[0])
        hidden = functional.pad(hidden, (0, 0, 0, rows - len(hidden)))
        neighbours = functional.pad(neighbours, (0, 0, 0, rows - count), value=-1)
        for block in self.trunk:
            hidden = block(hidden, neighbours, backend)
        return functional.leaky_relu(hidden, LEAK)

    def _enter(self, inputs: Sequence[Tensor]) -> Tensor:
        """`enter` of all inputs beside each other, without writing them there."""
        weights = self.enter.weight.split([x.shape[1] for x in inputs], dim=1)
        parts = [functional.linear(x, w) for x, w in zip(inputs, weights, strict=True)]
        return sum(parts[1:], parts[0] + self.enter.bias)

    def base(self, observations: Sequence[Observation]) -> Tensor:
        """See `Renderer2d`."""
        return self._paint(observations, _join([self._base(o) for o in observations]))

    def _inputs(self, observation: Observation) -> list[Tensor]:
        """The base [N, s^2, 3], then what each group of `_input_groups` has in every cell,
        [N, slots, features]."""
        o, base = observation, self._base(observation)
        values = o.frame.values.flatten(0, 1)[o.cells] - o.background
        inputs = [base, _tell(values, o.frame.alpha.flatten()[o.cells, None])[:, None]]
        inputs += [self._preceding(o, age) for age in range(self.frames)]
        if self.history:
            inputs.append(self._recent(o, base))
        if self.surface:
            inputs.append(self._detail(o, base))
        return inputs

    def _base(self, observation: Observation) -> Tensor:
        """RGB of the frame less the background, enlarged bilinearly: [N, s^2, 3].

        A pixel lies between its 3 x 3 nearest samples, whatever the phase; beyond the frame its
        border goes on.
        """
        height, width, _ = observation.frame.values.shape
        around = torch.arange(-1, 2, device=observation.cells.device)
        row = (observation.cells // width)[:, None] + around.repeat_interleave(3)
        column = (observation.cells % width)[:, None] + around.repeat(3)
        near = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)  # [N, 9]
        colours = (observation.frame.values[..., :3] - observation.background[:3]).flatten(0, 1)
        across, down = (_tent(self.scale, shift).to(colours) for shift in observation.phase)
        weights = (down[:, None, :, None] * across[None, :, None, :]).reshape(-1, TAPS)  # [s^2, 9]
        samples = colours[near].transpose(1, 2).flatten(0, 1)  # [3 N, 9]
        with torch.autocast(colours.device.type, enabled=False):
            return (samples @ weights.T).view(-1, 3, len(weights)).transpose(1, 2)

    def _preceding(self, observation: Observation, age: int) -> Tensor:
        """What a preceding frame has, [N, s^2, K + 1]: less the background, and whether."""
        background = observation.background
        if age >= len(observation.preceding):
            shape = len(observation.cells), self.scale**2, self.channels + 1
            return background.new_zeros(shape)
        points = observation.preceding[age]
        less = points.values - background
        index = pixels_of(points.index, observation.cells, self.scale)
        return gather(_tell(less, torch.ones_like(less[:, :1])), index, backend=observation.backend)

    def _recent(self, observation: Observation, base: Tensor) -> Tensor:
        """The preceding picture less the base, and where it is known, [N, s^2, 4]."""
        recent = observation.history
        if recent is None:
            return base.new_zeros(*base.shape[:2], 4)
        known = recent.valid[..., None]
        return torch.cat(((recent.values - observation.background[:3] - base) * known, known), -1)

    def _detail(self, observation: Observation, base: Tensor) -> Tensor:
        """Of the surface of each pixel, [N, s^2, K + 1]: RGB less the base, opacity, the rest."""
        points = observation.surface
        if points is None:
            return base.new_zeros(*base.shape[:2], self.channels + 1)
        told = _tell(points.values[:, :-1] - observation.background, points.values[:, -1:])
        shown = gather(told, points.index, backend=observation.backend)
        less = base * (points.index >= 0)[..., None]
        return shown - functional.pad(less, (0, self.channels - 2))

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
        unused = {name for name in generic if name.startswith("read") and not self.surface}
        ours, theirs = _same_columns(self._input_groups(), GENERIC_GROUPS)
        slots = range(self.scale**2)
        written = [4 * slot + i for slot in slots for i in range(3 + self.history)]
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
    if torch.is_grad_enabled():
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


def _join(parts: Sequence[Tensor]) -> Tensor:
    """One after the other; nothing is copied if there is one."""
    return torch.cat(list(parts)) if len(parts) > 1 else parts[0]


def _tell(values: Tensor, known: Tensor) -> Tensor:
    """`known` [N, 1] put behind the colours of `values` [N, K]."""
    return torch.cat((values[:, :3], known, values[:, 3:]), dim=1)


def _tent(scale: int, shift: float) -> Tensor:
    """[s, 3] weights of the samples at -1, 0, 1 for the s pixels between -1/2 and 1/2."""
    place = (torch.arange(scale) + 0.5 - shift) / scale - 0.5
    return (1 - (place[:, None] - torch.tensor((-1.0, 0.0, 1.0))).abs()).clamp(min=0)
