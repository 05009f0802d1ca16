"""The 2D renderer of SteerNeRF's released code, a U-Net at full resolution."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe
from methods.engines.network import Network
from methods.kernels.splat import gather
from methods.steernerf.renderer import UNWATCHED, Drawing, Observation, Renderer2d


class UNet(Renderer2d):
    """The U-Net of the released code (`ReconstructionNet_v4`), at full resolution.

    Its input are the features of all frames, zero where nothing is: those of the present one at
    every s-th pixel, those of the preceding ones where they land. Its output is added to the
    bilinearly enlarged RGB of the present frame. 2,115,587 parameters at L = 2, K = 6.

    Args:
        channels: K.
        frames: L.
        scale: s.
        aligned: the base has its corners, and so all pixels but the middle one, in the wrong place
            (False: as the release) or in the right one.
    """

    def __init__(self, channels: int, frames: int, scale: int, *, aligned: bool = False) -> None:
        super().__init__()
        self.channels, self.frames, self.scale, self.aligned = channels, frames, scale, aligned
        self.network = _Network(channels * (frames + 1))

    def forward(self, observations: Sequence[Observation], probe: Probe = UNWATCHED) -> Drawing:
        """See `Renderer2d`."""
        inputs = torch.stack([self._inputs(o) for o in observations])
        (correction,) = self.run(probe, inputs)
        return Drawing(self.base(observations) + correction.to(inputs).permute(0, 2, 3, 1))

    def base(self, observations: Sequence[Observation]) -> Tensor:
        """See `Renderer2d`."""
        rgb = torch.stack([o.frame.values[..., :3] for o in observations]).permute(0, 3, 1, 2)
        enlarged = functional.interpolate(
            rgb, scale_factor=self.scale, mode="bilinear", align_corners=not self.aligned
        )
        return enlarged.permute(0, 2, 3, 1)

    def _inputs(self, observation: Observation) -> Tensor:
        """[K (L + 1), H, W]: the RGB of all frames, then their other features."""
        values = observation.frame.values
        height, width = values.shape[0] * self.scale, values.shape[1] * self.scale
        present = values.new_zeros(height, width, self.channels)
        present[:: self.scale, :: self.scale] = values
        frames = [present] + [
            gather(p.values, p.index, backend=observation.backend) for p in observation.preceding
        ]
        frames += [torch.zeros_like(present)] * (self.frames + 1 - len(frames))
        rgb, rest = ([f[..., part] for f in frames] for part in (slice(0, 3), slice(3, None)))
        return torch.cat((*rgb, *rest), dim=-1).permute(2, 0, 1)


class _Network(Network):
    varying = ((),)

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.first = _conv(inputs, 64)
        self.enter = _conv(64, 64)
        self.at_half = _Residual(64)
        self.narrow = _conv(64, 128)
        self.at_quarter = nn.Sequential(*(_Residual(128) for _ in range(3)))
        self.widen_quarter = _conv(128, 512)
        self.merge_half = _conv(192, 64)
        self.half_again = _Residual(64)
        self.widen_half = _conv(64, 256)
        self.merge_full = _conv(128, 64)
        self.last = nn.Sequential(_conv(64, 64), nn.ReLU(), _conv(64, 3))

    def forward(self, inputs: Tensor) -> tuple[Tensor]:
        """[B, C, H, W] to [B, 3, H, W]."""
        height, width = inputs.shape[-2:]
        # Two halvings: sizes that are no multiple of 4 are padded, and the padding cut off.
        padded = functional.pad(inputs, (0, -width % 4, 0, -height % 4))
        full = self.enter(self.first(padded)).relu()
        half = self.at_half(functional.max_pool2d(full, 2)).relu()
        quarter = self.narrow(functional.max_pool2d(half, 2)).relu()
        quarter = self.widen_quarter(self.at_quarter(quarter).relu()).relu()
        quarter = functional.pixel_shuffle(quarter, 2)
        merged = self.merge_half(torch.cat((quarter, half), dim=1)).relu()
        merged = self.widen_half(self.half_again(merged)).relu()
        merged = functional.pixel_shuffle(merged, 2)
        merged = self.merge_full(torch.cat((merged, full), dim=1)).relu()
        return (self.last(merged)[..., :height, :width],)

    def products(self, *inputs: Tensor) -> int:
        """See `Network`: every kernel once a pixel of the size at which it is used."""
        batch, _, height, width = inputs[0].shape
        full = batch * (-(-height // 4) * 4) * (-(-width // 4) * 4)
        used = {
            full: (self.first, self.enter, self.merge_full, self.last),
            full // 4: (self.at_half, self.merge_half, self.half_again, self.widen_half),
            full // 16: (self.narrow, self.at_quarter, self.widen_quarter),
        }
        return sum(
            pixels * x.numel()
            for pixels, layers in used.items()
            for layer in layers
            for x in layer.parameters()
            if x.dim() > 1
        )


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)
        for layer in (self.first, self.second):
            with torch.no_grad():
                layer.weight.mul_(0.1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x).relu())


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)
