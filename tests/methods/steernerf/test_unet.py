"""The U-Net of the released code: its size, its base, what it is shown."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from methods.steernerf.unet import UNet
from tests.methods.observations import ROUNDING, doubled, features_of, observe, shaken


@pytest.mark.parametrize(("frames", "count"), [(0, 2_108_675), (1, 2_112_131), (2, 2_115_587)])
def test_it_has_the_number_of_parameters_of_the_release(frames: int, count: int) -> None:
    renderer = UNet(6, frames, 4)
    assert sum(parameter.numel() for parameter in renderer.parameters()) == count


@pytest.mark.parametrize(
    ("channels", "frames", "scale", "height", "width"),
    [(6, 2, 4, 5, 7), (3, 0, 4, 3, 4), (8, 1, 3, 5, 3), (6, 3, 2, 3, 5), (4, 1, 1, 9, 6)],
)
def test_any_features_frames_and_sizes_are_taken(
    channels: int, frames: int, scale: int, height: int, width: int
) -> None:
    """Sides of the picture that are no multiple of 4 as well: of 15 x 9, 6 x 10 and 9 x 6."""
    renderer = UNet(channels, frames, scale)
    observations = [
        observe(height, width, channels=channels, frames=frames, scale=scale, seed=seed)
        for seed in range(2)
    ]
    for batch in (observations[:1], observations):
        pictures, base = renderer(batch).pictures, renderer.base(batch)
        assert pictures.shape == base.shape == (len(batch), height * scale, width * scale, 3)
        assert pictures.isfinite().all()


@pytest.mark.parametrize(("height", "width"), [(8, 12), (9, 6)])
def test_its_products_are_those_that_torch_counts(height: int, width: int) -> None:
    network = UNet(6, 2, 4).network
    inputs = torch.zeros(2, 18, height, width)
    with FlopCounterMode(display=False) as counter:
        network(inputs)
    assert 2 * network.products(inputs) == counter.get_total_flops()


def test_frames_that_are_missing_after_a_cold_start_show_nothing() -> None:
    renderer = shaken(UNet(6, 2, 4)).double()
    warm = doubled(observe())
    empty = replace(warm.preceding[1], index=torch.full_like(warm.preceding[1].index, -1))
    pictures = renderer([replace(warm, preceding=warm.preceding[:1])]).pictures
    unseen = renderer([replace(warm, preceding=[warm.preceding[0], empty])]).pictures
    assert torch.equal(pictures, unseen)
    cold = renderer([replace(warm, preceding=[])]).pictures
    assert cold.isfinite().all()
    assert (cold - pictures).abs().max() > 1e-3


def test_a_batch_of_two_is_one_after_the_other() -> None:
    renderer = shaken(UNet(6, 1, 4)).double()
    observations = [doubled(observe(frames=1, seed=seed)) for seed in range(2)]
    alone = torch.cat([renderer([observation]).pictures for observation in observations])
    torch.testing.assert_close(renderer(observations).pictures, alone, rtol=0, atol=ROUNDING)


def test_neither_the_preceding_picture_nor_the_surface_is_looked_at() -> None:
    renderer = shaken(UNet(6, 1, 4))
    observation = observe(frames=1)
    without = replace(observation, history=None, surface=None)
    assert torch.equal(renderer([observation]).pictures, renderer([without]).pictures)


def test_gradients_reach_every_parameter_and_the_features_of_all_frames() -> None:
    renderer = shaken(UNet(6, 2, 4))
    observation = observe(surface=False)
    features = [tensor.requires_grad_() for tensor in features_of(observation)]
    renderer([observation]).pictures.square().sum().backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
    for tensor in features:
        assert tensor.grad is not None
        assert tensor.grad.any(dim=0).all()  # every channel, RGB and others


@pytest.mark.parametrize("aligned", [False, True])
def test_the_base_puts_the_corners_on_corners_or_centres(aligned: bool) -> None:
    height, width, scale = 4, 6, 4
    observation = observe(height, width, frames=0)
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    observation.frame.values[..., 0], observation.frame.values[..., 1] = row / 8, column / 8
    base = UNet(6, 0, scale, aligned=aligned).base([observation])
    for channel, size in ((0, height), (1, width)):
        pixel = torch.arange(size * scale)
        if aligned:
            place = ((pixel + 0.5) / scale - 0.5).clamp(0, size - 1)
        else:
            place = pixel * (size - 1) / (size * scale - 1)
        ramp = base[0, :, 0, 0] if channel == 0 else base[0, 0, :, 1]
        torch.testing.assert_close(ramp, place / 8, rtol=0, atol=1e-6)


def test_without_an_output_of_the_network_the_picture_is_the_base() -> None:
    renderer = UNet(6, 2, 4, aligned=True)
    for layer in renderer.network.last[2].parameters():
        torch.nn.init.zeros_(layer)
    observation = observe()
    base = renderer.base([observation])
    assert torch.equal(renderer([observation]).pictures, base)
    rgb = observation.frame.values[..., :3].permute(2, 0, 1)[None]
    want = functional.interpolate(rgb, scale_factor=4, mode="bilinear", align_corners=False)
    assert torch.equal(base, want.permute(0, 2, 3, 1))
