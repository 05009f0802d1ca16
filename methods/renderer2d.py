"""The 2D neural renderers: from low-resolution features to the picture (SteerNeRF, Section 3.4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from methods.kernels.splat import gather
from methods.volume import FeatureFrame

REACH = 2
"""Low-resolution pixels around matter that are still given to the network: what is further from
anything that was seen is background."""

GENERIC = Path(__file__).parent / "weights" / "generic.safetensors"
"""Weights trained on other scenes by `steerbench generic`; see its help."""

LEAK = 0.1
"""Slope of the activations below 0. With a slope of 0 the sparse inputs kill a trunk for good."""


@dataclass(frozen=True)
class Reprojected:
    """A preceding frame in the present view: `values` [N, K] of points and the `index` [H, W] of
    the point that each full-resolution pixel shows, -1 for none."""

    values: Tensor
    index: Tensor
    backend: str = "auto"

    def at(self, index: Tensor) -> Tensor:
        """Values [..., K] of the points at `index` [...], zeros where it is -1."""
        return gather(self.values, index, backend=self.backend)


@dataclass(frozen=True)
class Detail:
    """What is known pixel by pixel, in blocks: `values` [h, w, s^2, C], `valid` [h, w, s^2]."""

    values: Tensor
    valid: Tensor


@dataclass(frozen=True)
class Observation:
    """All that is known of a picture before it is drawn.

    Attributes:
        frame: the present features, [h, w, K].
        background: [K] that they are composited on.
        preceding: newest first; fewer than L after a cold start.
        history: the newest preceding picture; None after a cold start, or where it is not used.
        surface: features of the field where the low-resolution depth has the surface of a pixel;
            None where they are not used.
        phase: of the samples of `frame` against the centres of its pixels, in pixels of the
            picture.
    """

    frame: FeatureFrame
    background: Tensor
    preceding: Sequence[Reprojected]
    history: Detail | None
    surface: Detail | None = None
    phase: tuple[float, float] = (0.0, 0.0)


class Renderer2d(nn.Module, ABC):
    """A network that turns observations into pictures."""

    @abstractmethod
    def forward(self, observations: Sequence[Observation]) -> tuple[Tensor, Tensor]:
        """Pictures [B, H, W, 3], and the base [B, H, W, 3] that the network corrected."""


class UnetRelease(Renderer2d):
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
        self.first = _conv(channels * (frames + 1), 64)
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

    def forward(self, observations: Sequence[Observation]) -> tuple[Tensor, Tensor]:
        """See `Renderer2d`."""
        rgb = torch.stack([o.frame.values[..., :3] for o in observations]).permute(0, 3, 1, 2)
        base = functional.interpolate(
            rgb,
            scale_factor=self.scale,
            mode="bilinear",
            align_corners=not self.aligned,
        )
        inputs = torch.stack([self._inputs(o) for o in observations])
        return _channels_last(base + self._network(inputs)), _channels_last(base)

    def _inputs(self, observation: Observation) -> Tensor:
        """[K (L + 1), H, W]: the RGB of all frames, then their other features."""
        values = observation.frame.values
        height, width = values.shape[0] * self.scale, values.shape[1] * self.scale
        present = values.new_zeros(height, width, self.channels)
        present[:: self.scale, :: self.scale] = values
        frames = [present] + [p.at(p.index) for p in observation.preceding]
        frames += [torch.zeros_like(present)] * (self.frames + 1 - len(frames))
        rgb, rest = ([f[..., part] for f in frames] for part in (slice(0, 3), slice(3, None)))
        return torch.cat((*rgb, *rest), dim=-1).permute(2, 0, 1)

    def _network(self, inputs: Tensor) -> Tensor:
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
        return self.last(merged)[..., :height, :width]


class SpaceToDepth(Renderer2d):
    """A network that works at low resolution throughout: s x s pixels are channels of one.

    A picture is the aligned bilinear enlargement of the present RGB, blended pixel by pixel with
    the preceding picture where that is known, plus a correction. All features enter with the
    background taken away, so that nothing is 0. Activations are 0 beyond `REACH` pixels of
    anything, and the picture is background there: a part of a frame is drawn exactly as the whole.

    Args:
        channels: K.
        frames: L.
        scale: s.
        width: channels of the trunk.
        blocks: residual blocks of two 3 x 3 convolutions.
        init: "generic": start from the weights that come with the package, trained on other
            scenes; "scratch": from random ones.
        history: use the preceding picture.
        surface: use the features at the surface, pixel by pixel.
        validity: tell the network at which pixels preceding features land.
    """

    def __init__(
        self,
        channels: int,
        frames: int,
        scale: int,
        *,
        width: int = 64,
        blocks: int = 5,
        init: Literal["generic", "scratch"] = "generic",
        history: bool = True,
        surface: bool = True,
        validity: bool = True,
    ) -> None:
        super().__init__()
        self.channels, self.frames, self.scale = channels, frames, scale
        self.history, self.validity = history and frames > 0, validity
        cell = scale**2
        self.present = nn.Conv2d(channels + 1, width, 3, padding=1)
        self.preceding = nn.ModuleList(
            nn.Conv2d(cell * (channels + validity), width, 1, bias=False) for _ in range(frames)
        )
        self.recent = nn.Conv2d(cell * 4, width, 1, bias=False) if self.history else None
        self.on_surface = (
            nn.Conv2d(cell * (channels + 1), width, 1, bias=False) if surface else None
        )
        self.trunk = nn.ModuleList(_LeakyResidual(width) for _ in range(blocks))
        self.last = _conv(width, cell * (3 + self.history + surface))
        for parameter in self.last.parameters():
            nn.init.zeros_(parameter)  # in the beginning, the base

    @torch.no_grad()
    def _start_from(self, generic: Mapping[str, Tensor]) -> None:
        """Take over the weights of a renderer of the same trunk that was trained at K = 3.

        Weights of features beyond RGB, and of frames it did not have, stay as they are.
        """
        for name, weight in self.named_parameters():
            if name not in generic:
                continue
            new = generic[name].float()
            columns = self._columns_of_colour(name, weight)
            if name.startswith("last"):
                new = new[: len(weight)]
            if (weight[:, columns] if columns else weight).shape != new.shape:
                raise ValueError(
                    f"renderer.init=generic: {name} is {list(weight.shape)}, the generic weights "
                    f"have {list(new.shape)}: use renderer.init=scratch, or the width, blocks, "
                    "scale, history, surface and validity of the default"
                )
            if columns:
                weight[:, columns] = new
            else:
                weight.copy_(new)

    def _columns_of_colour(self, name: str, weight: Tensor) -> list[int]:
        """Inputs of a layer that a renderer of K = 3 has as well; [] for all."""
        cell = self.scale**2
        if name == "present.weight":
            return [0, 1, 2, self.channels]
        if name.startswith("preceding"):
            each = self.channels + self.validity
            return [slot * each + i for slot in range(cell) for i in (0, 1, 2, self.channels)]
        if name == "on_surface.weight":
            return [*range(3 * cell), *range(self.channels * cell, weight.shape[1])]
        return []

    def forward(self, observations: Sequence[Observation]) -> tuple[Tensor, Tensor]:
        """See `Renderer2d`."""
        cells = [self._active(o) for o in observations]
        if len(observations) == 1:
            box = _bounding_box(cells[0])
        else:
            box = slice(0, cells[0].shape[0]), slice(0, cells[0].shape[1])
        drawn, base = self._draw(observations, torch.stack(cells)[:, None], box)
        height, width = cells[0].shape
        rows, columns = box
        around = (columns.start, width - columns.stop, rows.start, height - rows.stop)
        around = tuple(self.scale * side for side in around)
        background = observations[0].background[:3, None, None]
        pictures = []
        for part in (drawn, base):
            part = functional.pixel_shuffle(part, self.scale)
            pictures.append(_channels_last(functional.pad(part, around) + background))
        return pictures[0], pictures[1]

    def _active(self, observation: Observation) -> Tensor:
        """[h, w] in {0, 1}: where there is anything within `REACH`."""
        some = observation.frame.alpha > 0
        for frame in observation.preceding:
            some = some | (_blocks(frame.index, self.scale) >= 0).any(dim=-1)
        grown = functional.max_pool2d(some[None].float(), 2 * REACH + 1, stride=1, padding=REACH)
        return grown[0]

    def _draw(
        self, observations: Sequence[Observation], active: Tensor, box: tuple[slice, slice]
    ) -> tuple[Tensor, Tensor]:
        """Picture and base [B, 3 s^2, ...] of the low-resolution pixels in `box`, less the
        background."""
        active = active[..., *box]
        present = torch.stack([self._present(o)[box] for o in observations]).permute(0, 3, 1, 2)
        base = torch.cat(
            [
                _enlarge(present[i : i + 1, :3], self.scale, o.phase)
                for i, o in enumerate(observations)
            ]
        )
        hidden = self.present(present)
        for age, layer in enumerate(self.preceding):
            seen = [self._preceding(o, age, box) for o in observations]
            hidden = hidden + layer(torch.stack(seen).permute(0, 3, 1, 2))
        offers = []
        for take, channels, details in (
            (self.recent, 3, [o.history for o in observations]),
            (self.on_surface, self.channels, [o.surface for o in observations]),
        ):
            if take is not None:
                offer = self._offer(details, observations[0].background[:channels], base, box)
                hidden = hidden + take(torch.cat(offer, dim=1))
                offers.append(offer)
        hidden = functional.leaky_relu(hidden, LEAK) * active
        for block in self.trunk:
            hidden = block(hidden, active)
        out, count = self.last(hidden), base.shape[1]
        correction, *shares = out.split((count, *[self.scale**2] * len(offers)), dim=1)
        drawn = base + correction
        for share, (values, valid) in zip(shares, offers, strict=True):
            drawn = drawn + values[:, :count] * (share.sigmoid() * valid).repeat(1, 3, 1, 1)
        return drawn * active, base * active

    def _present(self, observation: Observation) -> Tensor:
        frame = observation.frame
        return torch.cat((frame.values - observation.background, frame.alpha[..., None]), dim=-1)

    def _preceding(self, observation: Observation, age: int, box: tuple[slice, slice]) -> Tensor:
        """[h, w, s^2 (K + 1)] what the frame of this age left at the pixels of each cell."""
        if age >= len(observation.preceding):
            rows, columns = (side.stop - side.start for side in box)
            shape = rows, columns, self.scale**2 * (self.channels + self.validity)
            return observation.frame.values.new_zeros(shape)
        frame = observation.preceding[age]
        values = frame.values - observation.background
        if self.validity:
            values = functional.pad(values, (0, 1), value=1.0)
        index = _blocks(frame.index, self.scale)[box].contiguous()
        return replace(frame, values=values).at(index).flatten(start_dim=2)

    def _offer(
        self,
        details: Sequence[Detail | None],
        background: Tensor,
        base: Tensor,
        box: tuple[slice, slice],
    ) -> tuple[Tensor, Tensor]:
        """Another picture, to be chosen instead of the base.

        Returns:
            [B, C s^2, ...] its RGB less the base, and its other channels less the background, 0
            where not known; and [B, s^2, ...] where it is known.
        """
        values, valid = [], []
        for detail in details:
            if detail is None:
                shape = *base.shape[2:], self.scale**2
                values.append(base.new_zeros(*shape, len(background)))
                valid.append(base.new_zeros(shape))
            else:
                values.append(detail.values[box] - background)
                valid.append(detail.valid[box])
        known = torch.stack(valid).permute(0, 3, 1, 2)
        shown = torch.stack(values).transpose(3, 4).flatten(start_dim=3).permute(0, 3, 1, 2)
        less = functional.pad(base, (0, 0, 0, 0, 0, shown.shape[1] - base.shape[1]))
        return (shown - less) * known.repeat(1, len(background), 1, 1), known


class _Residual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)
        for layer in (self.first, self.second):
            with torch.no_grad():
                layer.weight.mul_(0.1)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(self.first(x).relu())


class _LeakyResidual(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.first, self.second = _conv(width, width), _conv(width, width)
        with torch.no_grad():
            self.second.weight.mul_(0.1)

    def forward(self, x: Tensor, active: Tensor) -> Tensor:
        hidden = functional.leaky_relu(self.first(x), LEAK) * active
        return x + self.second(hidden) * active


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    layer = nn.Conv2d(inputs, outputs, 3, padding=1)
    nn.init.kaiming_normal_(layer.weight)
    return layer


def _enlarge(image: Tensor, scale: int, phase: tuple[float, float]) -> Tensor:
    """Bilinear enlargement of [1, C, h, w] by `scale`, left in blocks: [1, C s^2, h, w].

    Pixel (i, j) of the image is a sample at (s (i + 1/2), s (j + 1/2)) + `phase` of the result; a
    phase of at most s / 2 keeps every pixel between its 3 x 3 nearest samples.
    """
    channels = image.shape[1]
    across, down = (_tent_weights(scale, shift).to(image) for shift in phase)
    kernel = (down[:, None, :, None] * across[None, :, None, :]).reshape(scale**2, 1, 3, 3)
    padded = functional.pad(image, (1, 1, 1, 1), mode="replicate")
    with torch.autocast(image.device.type, enabled=False):
        return functional.conv2d(padded, kernel.repeat(channels, 1, 1, 1), groups=channels)


def _tent_weights(scale: int, shift: float) -> Tensor:
    """[s, 3] weights of the samples at -1, 0, 1 for the s pixels between -1/2 and 1/2."""
    place = (torch.arange(scale) + 0.5 - shift) / scale - 0.5
    return (1 - (place[:, None] - torch.tensor((-1.0, 0.0, 1.0))).abs()).clamp(min=0)


def _blocks(index: Tensor, scale: int) -> Tensor:
    """[H, W] to [h, w, s^2]: the pixels of each low-resolution pixel, row by row."""
    height, width = index.shape
    blocks = index.view(height // scale, scale, width // scale, scale)
    return blocks.transpose(1, 2).flatten(start_dim=2)


def _bounding_box(active: Tensor) -> tuple[slice, slice]:
    """Rows and columns of [h, w] that hold all that is not 0; at least one of each."""
    box = []
    for dim in (1, 0):
        some = active.amax(dim=dim).nonzero().flatten().tolist() or [0]
        box.append(slice(some[0], some[-1] + 1))
    return box[0], box[1]


def _channels_last(images: Tensor) -> Tensor:
    """[B, 3, H, W] to [B, H, W, 3]."""
    return images.permute(0, 2, 3, 1)
