"""The 2D renderer: what it is shown, and the U-Net of the released code (Section 3.3)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.functional import max_pool2d, pixel_shuffle

from bench.types import NullProbe, Probe, SomeTensors
from methods.engines.network import Built
from methods.kernels.types import expect
from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Points

UNWATCHED = NullProbe()

Rectangle = tuple[slice, slice]  # rows and columns of a low-resolution frame

WHOLE = slice(None), slice(None)

RIM = 4  # pixels at the border of what is drawn, where the network reads zeros beyond
DIVISOR = 4  # of the sides of the network's pictures, which it halves twice


@dataclass(frozen=True)
class Observation:
    """What the U-Net is shown of a view."""

    frame: FeatureFrame  # the present features F, [h, w, K]
    preceding: Sequence[Points]  # of at most L preceding frames, newest first, in the `part`
    part: Rectangle = WHOLE  # of the frame, to be drawn


class UNet(nn.Module):
    """The U-Net of the released code (`ReconstructionNet_v4`), at full resolution.

    Its inputs are the features of all frames: those of the present frame at every s-th pixel, those
    of the preceding frames at the pixels where their points land, zero elsewhere. Its output is
    added to the *base*, the bilinearly enlarged RGB of the present frame. If the base is `aligned`,
    its pixels keep their places. In the release the corners of frame and patch do, so that the
    others move by up to (s - 1) / 2 pixels, which the network cannot know: they move in a patch as
    they never do in a frame. `channels`, `frames`, `scale` are K, L, s; `width` is the number of
    channels at full size. The `engine` computes the `network`, if there is one.
    """

    engine: Built | None = None

    def __init__(
        self, channels: int, frames: int, scale: int, *, width: int, aligned: bool
    ) -> None:
        super().__init__()
        expect(1 <= width <= 4096, "renderer.width", "1 to 4096", width)
        self.frames, self.scale, self.aligned = frames, scale, aligned
        self.network = _Layers(channels * (frames + 1), width)

    def forward(self, observations: Sequence[Observation], probe: Probe = UNWATCHED) -> Tensor:
        """Draw all observations, whose parts have one size: pictures I [B, H, W, 3]."""
        inputs = _stacked([self._input(shown) for shown in observations]).permute(0, 3, 1, 2)
        height, width = inputs.shape[-2:]
        if height % DIVISOR or width % DIVISOR:
            inputs = functional.pad(inputs, (0, -width % DIVISOR, 0, -height % DIVISOR))
        probe.count("products", self.network.products(inputs))
        with probe.stage("network"):
            corrections = (self.engine.run if self.engine else self.network)(inputs)  # Eq. 11
        corrections = corrections[..., :height, :width].permute(0, 2, 3, 1)
        drawn = zip(observations, corrections, strict=True)
        return _stacked([self._picture(shown, correction) for shown, correction in drawn])

    @torch.no_grad()
    def alive(self) -> bool:
        """Whether its corrections depend on what it is shown; they do not if all units of a layer
        died in training."""
        weight = self.network.first.weight
        noise = torch.rand(1, weight.shape[1], 32, 32, generator=torch.Generator().manual_seed(0))
        return bool(self.network(noise.to(weight)).std((2, 3)).any())

    def _input(self, shown: Observation) -> Tensor:
        """What the network is shown, [H', W', K (L + 1)]: the RGB of all frames, newest first, then
        their other features. What is missing after a cold start is zero."""
        present = shown.frame.values[shown.part]
        device, (height, width, features) = present.device, present.shape
        height, width, count = self.scale * height, self.scale * width, self.frames + 1
        pixels = torch.arange(height * width, device=device).view(height, width)
        pixels = pixels[:: self.scale, :: self.scale].flatten()
        frames = [Points(present.flatten(0, 1), pixels), *shown.preceding]
        age, feature = (torch.arange(n, device=device) for n in (count, features))
        rgb = 3 * age[:, None] + feature
        other = 3 * count + (features - 3) * age[:, None] + feature - 3
        channels = torch.where(feature < 3, rgb, other)  # [L + 1, K]
        size = height * width + 1, features * count  # the last pixel is of points not shown
        pairs = zip(frames, channels, strict=False)
        places = torch.cat([size[1] * points.pixel[:, None] + of_age for points, of_age in pairs])
        dtype = self.engine.dtype if self.engine else present.dtype
        values = torch.cat([points.values for points in frames]).to(dtype)
        canvas = present.new_zeros(size, dtype=dtype)
        canvas.view(-1).index_put_((places,), values)  # Eq. 10
        return canvas[:-1].view(height, width, -1)

    def _picture(self, shown: Observation, correction: Tensor) -> Tensor:
        """The enlarged RGB [H, W, 3], with the `correction` [H', W', 3] of the part that is drawn.
        At the border of the part, the network reads zeros beyond. They change what it draws there
        by less than a grey level, but such a line across a white background costs 0.01 of LPIPS."""
        rgb = shown.frame.values[..., :3].permute(2, 0, 1)[None]
        size = [self.scale * side for side in rgb.shape[2:]]
        base = functional.interpolate(rgb, size, mode="bilinear", align_corners=not self.aligned)
        picture, inside, drawn = base[0].permute(1, 2, 0).contiguous(), [], []
        for one, side in zip(shown.part, rgb.shape[2:], strict=True):
            begin, end, _ = one.indices(side)
            first = self.scale * begin + (RIM if begin > 0 else 0)
            last = self.scale * end - (RIM if end < side else 0)
            inside.append(slice(first, last))
            drawn.append(slice(first - self.scale * begin, last - self.scale * begin))
        picture[tuple(inside)] += correction[tuple(drawn)]
        return picture


class _Layers(nn.Module):
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
        for x in self.parameters():
            if x.dim() == 4:  # as the inputs lie
                x.data = x.data.contiguous(memory_format=torch.channels_last)

    def forward(self, inputs: Tensor) -> Tensor:
        """[B, C, H, W] to [B, 3, H, W]; H and W are multiples of `DIVISOR`."""
        full = self.enter(self.first(inputs)).relu()
        half = self.at_half(max_pool2d(full, 2))
        quarter = self.at_quarter(self.narrow(max_pool2d(half, 2)).relu())
        wide = pixel_shuffle(self.widen_quarter(quarter), 2)
        half = self.half_again(self.merge_half(torch.cat((wide, half), 1)).relu())
        wide = pixel_shuffle(self.widen_half(half), 2)
        full = self.merge_full(torch.cat((wide, full), 1)).relu()
        return self.last(self.leave(full).relu())

    def products(self, inputs: Tensor) -> int:
        """Multiplications by weights: every kernel counts once per pixel at its resolution."""
        batch, _, *size = inputs.shape
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


def _stacked(pictures: SomeTensors) -> Tensor:
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
