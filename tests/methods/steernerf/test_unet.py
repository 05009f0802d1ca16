"""The U-Net of the released code: its size, its base, what it is shown."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from methods.engines import Built
from methods.rendering.frame import FeatureFrame
from methods.steernerf.buffer import Points
from methods.steernerf.unet import RIM, Observation, UNet
from tests.common import assert_near, seeded
from tests.methods.conftest import look_at_the_middle
from tests.methods.models import RELEASE, shaken

POINTS = 20


def observe(
    height: int = 5,
    width: int = 7,
    *,
    channels: int = 6,
    frames: int = 2,
    scale: int = 4,
    seed: int = 0,
    dtype: torch.dtype = torch.float32,
) -> Observation:
    """Random features in steps of 1/256, and preceding points, of which some are not shown."""
    generator = seeded(seed)
    values = torch.randint(257, (height, width, channels), generator=generator).to(dtype) / 256
    depth, alpha = torch.full((height, width), 1.5), torch.ones(height, width)
    size = scale**2 * height * width
    preceding = [
        Points(
            torch.rand(POINTS, channels, generator=generator).to(dtype),
            torch.randperm(size + POINTS, generator=generator)[:POINTS].clamp(max=size),
        )
        for _ in range(frames)
    ]
    camera = look_at_the_middle(0.0, 0.0)  # no renderer looks at it
    return Observation(FeatureFrame(camera, values, depth, alpha), preceding)


def unet(channels: int, frames: int, scale: int, width: int = 64, aligned: bool = False) -> UNet:
    return UNet(channels, frames, scale, width=width, aligned=aligned)


def hashed(count: int, number: int) -> Tensor:
    """`count` numbers in [0, 1), of a formula, in float64."""
    place = torch.arange(1, count + 1, dtype=torch.float64)
    x = 43758.5453 * torch.sin(12.9898 * place + 78.233 * (number + 1))
    return x - x.floor()


@pytest.mark.parametrize("frames", [0, 2])
def test_it_computes_what_the_released_network_computes(frames):
    network = unet(6, frames, 4).network
    convolutions = [layer for layer in network.modules() if isinstance(layer, nn.Conv2d)]
    with torch.no_grad():
        for number, layer in enumerate(convolutions):
            size, spread = layer.weight.numel(), math.sqrt(24 / (9 * layer.in_channels))
            layer.weight.copy_((spread * (hashed(size, number) - 0.5)).view_as(layer.weight))
            layer.bias.copy_(0.1 * (hashed(layer.out_channels, number + 100) - 0.5))
        inputs = hashed(6 * (frames + 1) * 16 * 24, 200).view(1, -1, 16, 24).float()
        output = network(inputs)
    wanted = torch.from_numpy(RELEASE[f"unet.{frames + 1}.out"])
    # 19 layers, each of sums of up to 1,728 products: their errors add up like sqrt(1728) roundings
    # of float32 a layer, of numbers as large as the largest output.
    tolerance = 19 * math.sqrt(1728) * 2.0**-24 * float(wanted.abs().max())
    assert_near(output[0], wanted, atol=tolerance)


def test_its_first_weights_are_drawn_as_those_of_the_release():
    """Residual blocks: Kaiming times 0.1; before a pixel shuffle: Kaiming; others as torch does."""
    network = unet(6, 2, 4).network
    layers = {n: x for n, x in network.named_modules() if isinstance(x, nn.Conv2d)}
    for name, layer in layers.items():
        residual, shuffled = "." in name or "again" in name, name.startswith("widen")
        kaiming = math.sqrt(2 / (9 * layer.in_channels))
        wanted = kaiming * (0.1 if residual else 1 if shuffled else math.sqrt(1 / 6))
        samples = layer.weight.numel()
        assert layer.weight.std().item() == pytest.approx(wanted, rel=5 / math.sqrt(2 * samples))
        assert (residual or shuffled) == (not layer.bias.any())


@pytest.mark.parametrize(
    ("channels", "frames", "scale", "height", "width"),
    [(6, 2, 4, 5, 7), (3, 0, 4, 3, 4), (8, 1, 3, 5, 3), (6, 3, 2, 3, 5), (4, 1, 1, 9, 6)],
)
def test_any_features_frames_and_sizes_are_taken(channels, frames, scale, height, width):
    """Sides of the picture that are no multiple of 4 as well: of 15 x 9, 6 x 10 and 9 x 6."""
    renderer = unet(channels, frames, scale)
    observations = [
        observe(height, width, channels=channels, frames=frames, scale=scale, seed=seed)
        for seed in range(2)
    ]
    for batch in (observations[:1], observations):
        pictures = renderer(batch)
        assert pictures.shape == (len(batch), height * scale, width * scale, 3)
        assert pictures.isfinite().all()


@pytest.mark.parametrize(("height", "width", "channels"), [(8, 12, 64), (4, 8, 16)])
def test_its_products_are_those_that_torch_counts(height, width, channels):
    network = unet(6, 2, 4, channels).network
    inputs = torch.zeros(2, 18, height, width)
    with FlopCounterMode(display=False) as counter:
        network(inputs)
    assert 2 * network.products(inputs) == counter.get_total_flops()


def test_a_batch_of_two_is_one_after_the_other():
    renderer = shaken(unet(6, 1, 4)).double()
    observations = [observe(frames=1, seed=seed, dtype=torch.float64) for seed in range(2)]
    alone = torch.cat([renderer([observation]) for observation in observations])
    # Activations of 1 to 10, sums of up to 2,000 products in another order, a few tens of
    # u = 1.1e-16 a layer, a few layers deep.
    assert_near(renderer(observations), alone, atol=1e-12)


@pytest.mark.parametrize("aligned", [True, False])
def test_the_base_keeps_pixels_or_corners_in_their_places(aligned):
    """Without an output of the network, the picture is the base."""
    height, width, scale = 4, 6, 4
    observation = observe(height, width, frames=0)
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    observation.frame.values[..., 0], observation.frame.values[..., 1] = row / 8, column / 8
    renderer = unet(6, 0, scale, aligned=aligned)
    for layer in renderer.network.last.parameters():
        nn.init.zeros_(layer)
    base = renderer([observation])
    for channel, size in ((0, height), (1, width)):
        pixel = torch.arange(size * scale)
        place = pixel * (size - 1) / (size * scale - 1)
        if aligned:  # centres are at +1/2; beyond the outer ones it is as there
            place = ((pixel + 0.5) / scale - 0.5).clamp(0, size - 1)
        ramp = base[0, :, 0, 0] if channel == 0 else base[0, 0, :, 1]
        assert_near(ramp, place / 8, atol=1e-6)


@pytest.mark.parametrize("frames", [2, 3])
def test_a_pixel_has_the_features_of_its_points_and_every_fourth_the_present_ones(frames):
    """Frame by frame; with L = 3 one frame is missing."""
    height, width, scale, features = 2, 3, 4, 5
    shown = observe(height, width, channels=features, frames=2, scale=scale)
    seen, renderer = [], unet(features, frames, scale)
    renderer.engine = Built(lambda x: seen.append(x) or x[:, :3], 0)
    renderer([shown])
    of_each = torch.zeros(frames + 1, scale * height, scale * width, features)
    of_each[0, ::scale, ::scale] = shown.frame.values
    for canvas, points in zip(of_each[1:], shown.preceding, strict=False):
        inside = points.pixel < height * width * scale**2
        canvas.view(-1, features)[points.pixel[inside]] = points.values[inside]
    want = torch.cat([*of_each[..., :3], *of_each[..., 3:]], dim=2)
    assert torch.equal(seen[0][0], want.permute(2, 0, 1))


def test_features_of_16_bits_are_rounded_before_the_network_is_shown_them():
    seen, renderer = [], unet(6, 2, 4)
    for dtype in (torch.float32, torch.bfloat16):
        renderer.engine = Built(lambda x: seen.append(x) or x[:, :3], 0, dtype)
        renderer([observe()])
    assert seen[1].dtype == torch.bfloat16
    assert torch.equal(seen[1], seen[0].bfloat16())


def test_only_the_part_without_its_border_is_corrected():
    """Where the part ends with the picture, there is no border."""
    renderer, shown = unet(6, 0, 4), observe(12, 20, frames=0)
    renderer.engine = Built(lambda x: torch.full_like(x[:, :3], 0.25), 0)
    part = replace(shown, part=(slice(0, 8), slice(8, 16)))
    added = renderer([part])[0] - renderer([shown])[0] + 0.25
    drawn = torch.zeros(48, 80, dtype=torch.bool)
    drawn[: 32 - RIM, 32 + RIM : 64 - RIM] = True
    assert torch.equal(added.amax(2) > 0.2, drawn)
    assert added[drawn].min() > 0.2


def test_a_network_whose_units_died_is_told_from_one_that_draws():
    renderer = unet(4, 1, 4, width=4)
    assert renderer.alive()
    torch.nn.init.constant_(renderer.network.leave.bias, -1e9)
    assert not renderer.alive()
