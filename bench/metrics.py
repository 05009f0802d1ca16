"""Picture quality: PSNR, SSIM and LPIPS of a picture, flicker between two consecutive ones.

Every metric takes float pictures [H, W, 3] in [0, 1] and returns a Python float. None of them
clips or rounds: that is the protocol's choice, made with `quantise`.
"""

import math
import re
import warnings
from pathlib import Path

import numpy as np
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from bench.types import Log, SteerbenchError, Unavailable, check_shape
from bench.weights import load_features

SMALLEST_SIDE = {"psnr": 1, "ssim": 11, "lpips_alex": 31, "lpips_vgg": 16}
SMALLEST_SIDE |= {f"cc_{metric}": side for metric, side in SMALLEST_SIDE.items()}
"""Smallest side in pixels: SSIM needs room for its window, LPIPS for one feature at its deepest."""

FITS, SATURATED = 5, 0.5 / 255
"""Of a correction of colours: how often it is fitted; how close to 0 or 1 it is saturated."""


def check_size(metric: str, width: int, height: int) -> None:
    """Raise `SteerbenchError` if pictures of this size are too small for `metric`."""
    side = SMALLEST_SIDE[metric]
    if min(width, height) < side:
        advice = "use larger ones (a smaller scene.downscale), or with LPIPS a protocol without it"
        least = f"at least {side} x {side} pixels, got {width} x {height}"
        raise SteerbenchError(f"{metric} needs pictures of {least}: {advice}")


def quantise(image: Tensor) -> Tensor:
    """Clip to [0, 1] and round to the 256 levels of an 8-bit file, halves to the even level."""
    return image.clamp(0.0, 1.0).mul(255.0).round().div(255.0)


def as_bytes(image: Tensor) -> np.ndarray:
    """A picture in [0, 1], on the CPU, as 8-bit integers."""
    return image.mul(255.0).round().to(torch.uint8).numpy()


def psnr(image: Tensor, reference: Tensor, mask: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1, over all pixels or those in `mask` bool
    [H, W]; +inf where the pictures are equal there."""
    check_pair(image, reference)
    errors = (image.double() - reference.double()).square()
    return psnr_of_mse((errors if mask is None else errors[mask]).mean().item())


def psnr_of_mse(mse: float) -> float:
    """The PSNR in dB of a mean squared error, for a peak of 1; +inf for an error of 0."""
    return math.inf if mse == 0.0 else -10.0 * math.log10(mse)  # nan stays nan


def flicker(
    image: Tensor, reference: Tensor, previous_image: Tensor, previous_reference: Tensor
) -> float:
    """RMS of the change of the error from frame to frame: 0 for what is wrong but stands still."""
    check_pair(image, reference)
    check_pair(previous_image, previous_reference)
    check_shape("previous_image", previous_image, *image.shape)
    error = image.double() - reference.double()
    previous_error = previous_image.double() - previous_reference.double()
    return (error - previous_error).square().mean().sqrt().item()


def ssim(image: Tensor, reference: Tensor) -> float:
    """Structural similarity (Wang et al. 2004), k1 = .01, k2 = .03, per channel, then the mean.

    The window is Gaussian, 11 x 11 with sigma 1.5, with population covariance. The mean is taken
    over the valid region, where the window lies inside the picture. Raises SteerbenchError if a
    side is shorter than 11 pixels.
    """
    check_pair(image, reference)
    check_size("ssim", image.shape[1], image.shape[0])
    pair = (picture.double().cpu().numpy() for picture in (image, reference))
    window = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    return float(structural_similarity(*pair, data_range=1.0, channel_axis=-1, **window))


class Lpips:
    """LPIPS v0.1 (Zhang et al. 2018) with a named backbone; a lower value is more similar.

    The linear layers come with the `lpips` package, the backbone ("alex" or "vgg") from
    `bench.weights`, which searches `weights_dir` first. Runs in float32 on the device of the
    pictures, which are mapped to [-1, 1] as published. Raises Unavailable if the weights cannot be
    found or downloaded, or do not fit the network.
    """

    def __init__(self, net: str, weights_dir: Path | None, log: Log) -> None:
        self.net = net
        path, features = load_features(net, weights_dir, log)
        declare_torchvision()  # lpips needs it only for its network definitions
        import lpips

        with warnings.catch_warnings():  # lpips calls torchvision with deprecated arguments
            warnings.simplefilter("ignore", UserWarning)
            model = lpips.LPIPS(net=net, version="0.1", pnet_rand=True, verbose=False)
        # lpips cuts the backbone into slices but keeps torchvision's index of every layer.
        names = {name: re.sub(r"^slice\d+", "features", name) for name in model.net.state_dict()}
        try:
            model.net.load_state_dict({name: features[source] for name, source in names.items()})
        except (KeyError, RuntimeError) as error:
            expected = f"the `features.*` weights LPIPS ({net}) needs"
            raise Unavailable(f"{path}: expected {expected}; {error}") from error
        self._model = model.requires_grad_(False).to(memory_format=torch.channels_last)

    @torch.inference_mode()
    def __call__(self, image: Tensor, reference: Tensor) -> float:
        """LPIPS between two pictures [H, W, 3] in [0, 1]."""
        check_pair(image, reference)
        check_size(f"lpips_{self.net}", image.shape[1], image.shape[0])
        pair = torch.stack((image, reference)).float().permute(0, 3, 1, 2)  # channels last
        # float32 on a GPU, too: by default cuDNN rounds the inputs of convolutions to TF32.
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            distance = self._model.to(image.device)(pair[:1], pair[1:], normalize=True)
        self._model.cpu()  # on the GPU it would count as memory of the measured method
        return float(distance.item())


def colour_corrected(
    image: Tensor, reference: Tensor, mask: Tensor | None = None, quadratic: bool = False
) -> Tensor:
    """`image` in the colours that are most like those of `reference` in least squares, if each is a
    function of the colour before: a sum of its channels and a constant and, if `quadratic`, of
    their products, as in the evaluation of mip-NeRF 360 (`color_correct` of multinerf).

    As there, pixels that are saturated in a channel are left out, in the reference and before or
    after a fit, so it is fitted several times. Those not in `mask` bool [H, W] are left out and
    stay as they are, as does a channel without any others.
    """
    check_pair(image, reference)
    colours, wanted = (x.double().reshape(-1, 3) for x in (image, reference))
    fitted = _unsaturated(colours) & _unsaturated(wanted)  # [P, 3]
    if mask is not None:
        fitted &= mask.reshape(-1, 1)
    for _ in range(FITS):
        products = [colours[:, c:] * colours[:, c : c + 1] for c in range(3 * quadratic)]
        terms = torch.cat([*products, colours, torch.ones_like(colours[:, :1])], dim=1)  # [P, T]
        used, colours = fitted & _unsaturated(colours), colours.clone()
        for channel in used.any(dim=0).nonzero().flatten().tolist():
            rows = terms * used[:, channel, None]
            # Terms of a grey picture are alike: of all solutions, the shortest.
            inverse = torch.linalg.pinv(rows.T @ terms, rtol=1e-12, hermitian=True)
            colours[:, channel] = (terms @ (inverse @ (rows.T @ wanted[:, channel]))).clamp(0, 1)
    corrected = colours.view_as(image).to(image)
    return corrected if mask is None else corrected.where(mask[..., None], image)


def _unsaturated(colours: Tensor) -> Tensor:
    return (colours >= SATURATED) & (colours <= 1 - SATURATED)


def declare_torchvision() -> None:
    """Make torchvision importable whose binary does not load, beside a torch for another device.

    Two operators are then undeclared. Declaring them is enough for what needs no others.
    """
    try:
        import torchvision  # noqa: F401
    except RuntimeError as error:
        if "operator torchvision::" not in str(error):
            raise
        for name in ("nms", "qnms"):
            arguments = "Tensor dets, Tensor scores, float iou_threshold"
            torch.library.define(f"torchvision::{name}", f"({arguments}) -> Tensor")


def check_pair(image: Tensor, reference: Tensor) -> None:
    check_shape("image", image, None, None, 3)
    check_shape("reference", reference, *image.shape)
