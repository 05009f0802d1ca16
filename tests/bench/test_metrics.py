"""Metrics against closed forms, plain re-computations and the identities they must obey."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from bench.metrics import SMALLEST_SIDE, Lpips, colour_corrected, flicker, psnr, quantise, ssim
from bench.scoring import Scoring
from bench.types import Unavailable
from tests.common import refusal, seeded
from tests.conftest import STEERBENCH_1


def noise(height: int, width: int, seed: int = 0, device: str = "cpu") -> Tensor:
    return torch.rand(height, width, 3, generator=seeded(seed)).to(device)


def test_quantise_keeps_the_256_levels_and_clips_the_rest(device):
    levels = torch.arange(256, device=device) / 255
    assert torch.equal(quantise(levels), levels)
    beyond = torch.tensor([-math.inf, -0.2, 1.2, math.inf], device=device)
    assert quantise(beyond).tolist() == [0, 0, 1, 1]
    halves = torch.tensor([0.5, 1.5, 2.5], dtype=torch.float64, device=device) / 255
    assert (quantise(halves) * 255).round().tolist() == [0, 2, 2]


@given(st.floats(1e-4, 1.0))
def test_psnr_of_a_constant_offset_is_its_closed_form(offset):
    reference = torch.zeros(5, 7, 3, dtype=torch.float64)
    picture = reference + offset
    expected = pytest.approx(-20 * math.log10(offset), abs=1e-9)
    assert psnr(picture, reference) == psnr(reference, picture) == expected
    assert psnr(picture, picture) == math.inf
    assert math.isnan(psnr(picture * torch.nan, reference))


def test_flicker_is_the_change_of_the_error_alone(device):
    before, after, wrong = (noise(9, 8, seed, device).double() for seed in range(3))
    assert flicker(after, after, before, before) == 0
    assert flicker(after + wrong, after, before + wrong, before) == pytest.approx(0, abs=1e-15)
    # Half of the pixels become 0.3 brighter, the others as much darker: 0.3 each.
    blink = torch.where(torch.arange(8, device=device)[None, :, None] % 2 == 0, 0.3, -0.3).double()
    assert flicker(after + blink, after, before, before) == pytest.approx(0.3, rel=1e-7)
    shown = after + wrong, after, before, before
    expected = F.mse_loss(wrong, torch.zeros_like(wrong)).sqrt().item()
    assert flicker(*shown) == pytest.approx(expected, rel=1e-12)
    assert flicker(*shown[2:], *shown[:2]) == flicker(*shown)


def plain_correction(image: np.ndarray, truth: np.ndarray, quadratic: bool) -> np.ndarray:
    """`color_correct` as the evaluation of mip-NeRF 360 defines it, for pixels [P, 3]."""

    def unsaturated(x: np.ndarray) -> np.ndarray:
        return (x >= 0.5 / 255) & (x <= 1 - 0.5 / 255)

    now, first = image, unsaturated(image) & unsaturated(truth)
    for _ in range(5):
        r, g, b = now.T
        squares = [r * r, r * g, r * b, g * g, g * b, b * b] if quadratic else []
        terms = np.stack([*squares, r, g, b, np.ones_like(r)], axis=1)
        used, new = first & unsaturated(now), []
        for c in range(3):
            found = np.linalg.lstsq(terms[used[:, c]], truth[used[:, c], c], rcond=None)[0]
            new.append((terms @ found).clip(0, 1))
        now = np.stack(new, axis=1)
    return now


# Products of the channels of a grey picture are too alike for a comparison.
@pytest.mark.parametrize(("quadratic", "grey"), [(True, False), (False, False), (False, True)])
def test_colours_are_corrected_as_in_mip_nerf_360(quadratic, grey, device):
    image = noise(20, 30).double()
    image = image.mean(dim=2, keepdim=True).expand(-1, -1, 3) if grey else image
    mixed = image @ noise(3, 3, 1)[..., 0].double() / 2 + 0.1 - 0.2 * image.square()
    truth = (1.6 * mixed + 0.05 * noise(20, 30, 2)).clamp(0, 1).double()  # some are saturated
    found = colour_corrected(image.to(device), truth.to(device), quadratic=quadratic).cpu()
    pixels = (x.reshape(-1, 3).numpy() for x in (image, truth))
    expected = plain_correction(*pixels, quadratic).reshape(20, 30, 3)
    # The normal equations have the squared condition of the terms, about 1e6 here, in float64.
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert psnr(found, truth) > psnr(image, truth)
    half = torch.arange(30) < 15
    spoiled = torch.where(half[:, None], truth, 0.5)
    mask = half.expand(20, 30)
    among = colour_corrected(image, spoiled, mask, quadratic)
    assert torch.equal(among, colour_corrected(image, truth, mask, quadratic))
    assert torch.equal(colour_corrected(0 * image, truth), 0 * image)  # nothing can be fitted


def test_pictures_of_different_size_are_refused():
    small, large = noise(4, 5), noise(5, 4)
    with refusal(r"previous_image: expected shape \[4, 5, 3\]", ValueError):
        flicker(small, small, large, large)
    with refusal(r"reference: expected shape \[4, 5, 3\], got \[5, 4, 3\]", ValueError):
        psnr(small, large)


@torch.no_grad()
@pytest.mark.filterwarnings("ignore::UserWarning")  # lpips calls torchvision as it should not
@pytest.mark.parametrize(("net", "file"), [("alex", "alexnet"), ("vgg", "vgg16")])
def test_lpips_is_that_of_its_authors_with_the_weights_in_the_order_of_their_layers(
    net, file, lpips_weights, quiet_log, device
):
    """Its formula, in words of our own, is in `recompute.py`."""
    a = noise(50, 44, 7)
    b = (a + 0.2 * (noise(50, 44, 8) - 0.5)).clamp(0, 1)
    ours = Lpips(net, lpips_weights, quiet_log)
    measured = ours(a.to(device), b.to(device))
    import lpips  # after `Lpips`, see `bench.metrics`

    theirs = lpips.LPIPS(net=net, pnet_rand=True, verbose=False)
    weights = torch.load(lpips_weights / f"{file}_features.pth", weights_only=True)
    names = theirs.net.state_dict()
    theirs.net.load_state_dict(dict(zip(names, weights.values(), strict=True)))
    one, other = ((2 * x - 1).permute(2, 0, 1)[None] for x in (a, b))
    expected = theirs(one, other).item()
    # float32 convolutions of up to 4,608 products a position: relative error below 1e-4.
    assert measured == pytest.approx(expected, rel=1e-3)


def test_figures_are_those_of_nerfbaselines(device):
    """Of nerfbaselines/metrics.py at commit cde53bda36e6; which variant of the SSIM it is, too: its
    window, covariance, constants and region."""
    y, x = np.mgrid[0:64, 0:96]
    truth = np.stack([np.sin(x / 7), np.sin(y / 5 + x / 11), np.sin(x * y / 200)], -1)
    change = np.stack([np.sin(y / 3), np.sin(x / 4), np.cos(x * y / 90)], -1)
    levels = (np.rint(127.5 + values) for values in (100 * truth + 20 * change, 100 * truth))
    pictures = [torch.from_numpy(values / 255).float().to(device) for values in levels]
    assert psnr(*pictures) == pytest.approx(25.050917, rel=1e-6)
    assert ssim(*pictures) == pytest.approx(0.894081, abs=2e-6)


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_is_zero_for_equal_pictures_down_to_the_smallest_size(net, lpips_weights, quiet_log):
    lpips, side = Lpips(net, lpips_weights, quiet_log), SMALLEST_SIDE[f"lpips_{net}"]
    assert lpips(noise(side, side), noise(side, side)) == 0.0
    assert lpips(noise(side, side, 1), noise(side, side, 2)) > 0.0
    for metric, least in ((lpips, side), (ssim, 11)):
        with refusal(f"at least {least} x {least} pixels, got 40 x"):
            metric(noise(least - 1, 40), noise(least - 1, 40))


def test_lpips_refuses_the_weights_of_another_network(lpips_weights, quiet_log, tmp_path):
    path = tmp_path / "vgg16_features.pth"
    path.write_bytes((lpips_weights / "alexnet_features.pth").read_bytes())
    with refusal(r"vgg16_features.pth: expected the `features", Unavailable):
        Lpips("vgg", tmp_path, quiet_log)


def test_scoring_leaves_nothing_on_a_gpu(gpu, lpips_weights, quiet_log):
    """What lay there would count as memory of the method that is measured."""
    lpips = Lpips("alex", lpips_weights, quiet_log)
    scoring = Scoring(STEERBENCH_1, {}, torch.ones(3), ())
    pictures = [torch.rand(40, 40, 3).to("cuda") for _ in range(2)]
    assert math.isfinite(lpips(*pictures))
    truth = torch.zeros(40, 40, 3, dtype=torch.uint8)
    scoring.score(0, pictures[0], truth, scored=False, cut=False)
    kept = [*lpips._model.parameters(), *lpips._model.buffers(), *scoring._last[-1][:2]]
    assert {tensor.device.type for tensor in kept} == {"cpu"}
