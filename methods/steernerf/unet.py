"""The 2D renderer of SteerNeRF's released code, a U-Net at full resolution."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe
from methods.engines.network import Network
from methods.steernerf.kernels.splat import gather
from methods.steernerf.options import check_size
from methods.steernerf.renderer import UNWATCHED, Observation, Renderer2d


class UNet(Renderer2d):
    """The U-Net of the released code (`ReconstructionNet_v4`), at full resolution.

    Its inputs are the features of all frames: those of the present frame at every s-th pixel, those
    of the preceding frames at the pixels where their points land, zero elsewhere. Its output is
    added to the bilinearly enlarged RGB of the present frame. It has 2,115,587 parameters at L = 2,
    K = 6 and width 64, and gives the outputs of the release (tests/data/steernerf_release.npz).

    `channels`, `frames` and `scale` are K, L and s; `width` is the number of channels at full
    resolution. Enlarging the base keeps every pixel in its place if `aligned`; the release uses
    align_corners=True, which moves all pixels but the middle one.
    """

    def __init__(
        self, channels: int, frames: int, scale: int, *, width: int, aligned: bool
    ) -> None:
        super().__init__()
        check_size("renderer.width", width, 1, 4096)
        self.channels, self.frames, self.scale, self.aligned = channels, frames, scale, aligned
        self.network = _Network(channels * (frames + 1), width)

    def forward(self, observations: Sequence[Observation], probe: Probe = UNWATCHED) -> Tensor:
        """Draw all observations: pictures [B, H, W, 3]."""
        inputs = torch.stack([self._inputs(o) for o in observations])
        (correction,) = self.run(probe, inputs)  # Eq. 11
        return self.base(observations) + correction.to(inputs).permute(0, 2, 3, 1)

    def base(self, observations: Sequence[Observation]) -> Tensor:
        """The pictures [B, H, W, 3] that the network corrects: the present RGB, enlarged."""
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
    """The layers of `ReconstructionNet_v4`, with `width` channels at full resolution."""

    varying = ((),)

    def __init__(self, inputs: int, width: int) -> None:
        super().__init__()
        self.first, self.enter = _conv(inputs, width), _conv(width, width)
        self.at_half = _Residual(width)
        self.narrow = _conv(width, 2 * width)
        self.at_quarter = nn.ModuleList(_Residual(2 * width) for _ in range(3))
        self.widen_quarter = _conv(2 * width, 8 * width)
        self.merge_half, self.half_again = _conv(3 * width, width), _Residual(width)
        self.widen_half = _conv(width, 4 * width)
        self.merge_full, self.leave = _conv(2 * width, width), _conv(width, width)
        self.last = _conv(width, 3)
        for layer in (self.widen_quarter, self.widen_half):
            _kaiming(layer, 1.0)

    def forward(self, inputs: Tensor) -> tuple[Tensor]:
        """[B, C, H, W] to [B, 3, H, W]."""
        height, width = inputs.shape[-2:]
        # The size is halved twice: pad to a multiple of 4, and crop the result.
        padded = functional.pad(inputs, (0, -width % 4, 0, -height % 4))
        full = self.enter(self.first(padded)).relu()
        half = self.at_half(functional.max_pool2d(full, 2)).relu()
        quarter = self.narrow(functional.max_pool2d(half, 2)).relu()
        for block in self.at_quarter:
            quarter = block(quarter).relu()
        wide = functional.pixel_shuffle(self.widen_quarter(quarter), 2)
        merged = self.merge_half(torch.cat((wide, half), dim=1)).relu()
        merged = self.half_again(merged).relu()
        wide = functional.pixel_shuffle(self.widen_half(merged), 2)
        merged = self.merge_full(torch.cat((wide, full), dim=1)).relu()
        return (self.last(self.leave(merged).relu())[..., :height, :width],)

    def products(self, *inputs: Tensor) -> int:
        """Multiplications by weights: every kernel counts once per pixel at its resolution."""
        batch, _, height, width = inputs[0].shape
        pixels = batch * (-(-height // 4) * 4) * (-(-width // 4) * 4)
        half = (self.at_half, self.merge_half, self.half_again, self.widen_half)
        quarter = (self.narrow, self.at_quarter, self.widen_quarter)

        def weights(*layers: nn.Module) -> int:
            return sum(x.numel() for y in layers for x in y.parameters() if x.dim() > 1)

        lower = weights(*half), weights(*quarter)
        full = weights(self) - sum(lower)
        return pixels * full + pixels // 4 * lower[0] + pixels // 16 * lower[1]


class _Residual(nn.Module):
    """x + conv(ReLU(conv(x)))."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)
        for layer in (self.first, self.second):
            _kaiming(layer, 0.1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x).relu())


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)


def _kaiming(layer: nn.Conv2d, scale: float) -> None:
    """Initialise to `scale` times the weights of He et al. 2015 for ReLU, and zero bias."""
    nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    with torch.no_grad():
        layer.weight.mul_(scale)
