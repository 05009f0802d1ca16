"""What a 2D renderer is shown and how it draws, and that of the released code (Section 3.3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import max_pool2d, pixel_shuffle

from bench.types import NullProbe, Probe
from methods.engines.network import Built, Network
from methods.kernels.types import expect
from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Points
from methods.steernerf.kernels.drawing import corrected, shown

UNWATCHED = NullProbe()

Part = tuple[slice, slice]
"""Rows and columns of a low-resolution frame."""

WHOLE = slice(None), slice(None)

RIM = 4  # pixels at the border of what is drawn, where the network reads zeros beyond
DIVISOR = 4  # of the sides of the network's pictures, which it halves twice


@dataclass(frozen=True)
class Observation:
    """What the 2D renderer is shown."""

    frame: FeatureFrame  # the present features F, [h, w, K]
    preceding: Points  # of preceding frames, newest first, indices [L', H', W'], L' at most L
    backend: str  # of the kernels that a renderer calls
    part: Part = WHOLE  # of the frame, to be drawn; the H' x W' pixels are of this part

    def inside(self, height: int, width: int) -> Part:
        """What is drawn of the `height` x `width` pixels of the part, without its border.

        Zeros beyond the border change what the network draws there by less than a grey level, but
        such a line across a white background costs 0.01 of LPIPS.
        """
        kept = []
        for one, side, pixels in zip(
            self.part, self.frame.values.shape, (height, width), strict=False
        ):
            begin, end, _ = one.indices(side)
            kept.append(slice(RIM if begin else 0, pixels - (RIM if end < side else 0)))
        return kept[0], kept[1]


class Renderer2d(nn.Module):
    """Turns observations into pictures [B, H, W, 3] with a `network`, which an `engine` computes if
    set (Eq. 11). A subclass has a method `forward(observations, probe)`, as that of `UNet`."""

    network: Network
    engine: Built | None = None

    def run(self, probe: Probe, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Compute the network's output."""
        probe.count("products", self.network.products(*inputs))
        with probe.stage("network"):
            return (self.engine.run if self.engine else self.network)(*inputs)


class UNet(Renderer2d):
    """The U-Net of the released code (`ReconstructionNet_v4`), at full resolution.

    Its inputs are the features of all frames: those of the present frame at every s-th pixel, those
    of the preceding frames at the pixels where their points land, zero elsewhere. Its output is
    added to the bilinearly enlarged RGB of the present frame, which keeps every pixel in its place
    if `aligned`; the release uses align_corners=True, which moves all pixels but the middle one.
    `channels`, `frames`, `scale` are K, L, s; `width` is the number of channels at full size.
    """

    network: _Network

    def __init__(
        self, channels: int, frames: int, scale: int, *, width: int, aligned: bool
    ) -> None:
        super().__init__()
        expect(1 <= width <= 4096, "renderer.width", "1 to 4096", width)
        self.channels, self.frames, self.scale, self.aligned = channels, frames, scale, aligned
        self.network = _Network(channels * (frames + 1), width)
        self._memory = torch.empty(0)  # of the last input

    def forward(
        self,
        observations: Sequence[Observation],
        probe: Probe = UNWATCHED,
        *,
        clip: bool = False,
    ) -> Tensor:
        """Draw all observations, which have one size: pictures [B, H, W, 3], `clip`ped to [0, 1].
        Beyond what is `inside` its part, a picture is its base."""
        once = len(observations) == 1 and not torch.is_grad_enabled()
        inputs = _stacked([self._input(o, once) for o in observations]).permute(0, 3, 1, 2)
        height, width = inputs.shape[-2:]
        if height % DIVISOR or width % DIVISOR:
            inputs = functional.pad(inputs, (0, -width % DIVISOR, 0, -height % DIVISOR))
        (correction,) = self.run(probe, inputs)  # Eq. 11
        correction = correction[..., :height, :width]
        pictures = []
        for o, added in zip(observations, correction.permute(0, 2, 3, 1), strict=True):
            rgb, (top, left) = o.frame.values[..., :3], (side.start or 0 for side in o.part)
            rows, columns = o.inside(height, width)
            corner = self.scale * top + rows.start, self.scale * left + columns.start
            given = rgb, added[rows, columns], corner, self.scale, self.aligned
            picture = corrected(*given, clip=clip, backend=o.backend)
            pictures.append(picture)
        return _stacked(pictures)

    def _input(self, observation: Observation, once: bool) -> Tensor:
        """[H', W', K (L + 1)]; zeros for preceding frames that are missing after a cold start. If
        it is needed `once`, until the next call, it lies in the memory of the last one."""
        o, dtype = observation, None
        kind = o.frame.values.device.type
        if self.engine:
            dtype = self.engine.dtype
        elif torch.is_autocast_enabled(kind):
            dtype = torch.get_autocast_dtype(kind)
        given = o.frame.values[o.part], o.preceding.values, o.preceding.index, self.frames
        memory = self._memory if once else None
        canvas = shown(*given, dtype=dtype, memory=memory, backend=o.backend)
        if once and canvas.data_ptr() != self._memory.data_ptr():
            self._memory = canvas.view(-1)
        return canvas


class _Network(Network):
    """The layers of `ReconstructionNet_v4`, with `width` channels at full resolution."""

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.first, self.enter = _conv(inputs, width), _conv(width, width)
        self.at_half = _Residual(width)
        self.narrow = _conv(width, 2 * width)
        self.at_quarter = nn.Sequential(*(_Residual(2 * width) for _ in range(3)))
        self.widen_quarter = _conv(2 * width, 8 * width)
        self.merge_half, self.half_again = _conv(3 * width, width), _Residual(width)
        self.widen_half = _conv(width, 4 * width)
        self.merge_full, self.leave = _conv(2 * width, width), _conv(width, width)
        self.last = _conv(width, 3)
        for layer in (self.widen_quarter, self.widen_half):
            _kaiming(layer, 1.0)

    def forward(self, inputs: Tensor) -> tuple[Tensor]:
        """[B, C, H, W] to [B, 3, H, W]; H and W are multiples of `DIVISOR`."""
        full = self.enter(self.first(inputs)).relu()
        half = self.at_half(max_pool2d(full, 2))
        quarter = self.at_quarter(self.narrow(max_pool2d(half, 2)).relu())
        wide = pixel_shuffle(self.widen_quarter(quarter), 2)
        half = self.half_again(self.merge_half(torch.cat((wide, half), 1)).relu())
        wide = pixel_shuffle(self.widen_half(half), 2)
        full = self.merge_full(torch.cat((wide, full), 1)).relu()
        return (self.last(self.leave(full).relu()),)

    def products(self, *inputs: Tensor) -> int:
        """Multiplications by weights: every kernel counts once per pixel at its resolution."""
        batch, _, *size = inputs[0].shape
        half = dict.fromkeys(("at_half", "merge_half", "half_again", "widen_half"), 4)
        fewer = {**half, "narrow": 16, "at_quarter": 16, "widen_quarter": 16}
        weights = ((name.split(".")[0], x) for name, x in self.named_parameters() if x.dim() > 1)
        pixels = batch * math.prod(size)
        return sum(pixels // fewer.get(layer, 1) * x.numel() for layer, x in weights)


class _Residual(nn.Module):
    """ReLU(x + conv(ReLU(conv(x))))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)
        for layer in (self.first, self.second):
            _kaiming(layer, 0.1)

    def forward(self, x: Tensor) -> Tensor:
        return (x + self.second(self.first(x).relu())).relu()


def _stacked(pictures: Sequence[Tensor]) -> Tensor:
    """A batch of pictures; one alone is not copied."""
    return pictures[0][None] if len(pictures) == 1 else torch.stack(tuple(pictures))


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)


def _kaiming(layer: nn.Conv2d, scale: float) -> None:
    """Initialise to `scale` times the weights of He et al. 2015 for ReLU, and zero bias."""
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    layer.weight.data.mul_(scale)
