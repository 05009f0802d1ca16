"""Scores of rendered frames by a protocol, one after the other, with pictures of some of them."""

from collections import deque
from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from bench import metrics, video_metrics
from bench.errors import unexpected
from bench.protocol import EvaluationProtocol
from bench.types import ByCamera, Camera, Frame, SteerbenchError, composite

PICTURES = 3  # default number of scored frames whose pictures are kept
ERROR_RANGE = 0.1  # mean absolute error of the brightest colour of an error map


OUTSIDE = 0.05
"""How far the numbers of a picture may lie outside [0, 1] in the mean: a network that overshoots a
white background by less, a picture in other units, or of another range, by more."""


NEGATIVE, RARE = -0.2, 0.05
"""Numbers below the one are no overshoot where more than the other share of a picture are."""


def taken(frame: Frame, camera: Camera, method: str, index: int) -> Frame:
    """A copy of what a method rendered as frame `index`, which nothing that still runs can change.

    Raises SteerbenchError, which names `method`, if it is no Frame, or if a part has another size
    than `camera`, is no tensor of floating-point numbers, is not finite, or has another range than
    it must have.
    """
    where = f"{method}: frame {index}"
    if not isinstance(frame, Frame):  # whose parts may be made when they are asked for
        raise unexpected(where, "a bench.types.Frame", type(frame).__name__)
    size = camera.height, camera.width
    rgb = _copied(frame.rgb, f"{where}: rgb", (*size, 3))
    depth = _copied(frame.depth, f"{where}: depth", size)
    alpha = _copied(frame.alpha, f"{where}: alpha", size)
    broken = int((~rgb.isfinite()).any(dim=-1).sum())
    if broken:
        raise SteerbenchError(
            f"{method} rendered {broken} of {camera.height * camera.width} pixels of frame {index} "
            "as NaN or infinite: the training is broken; train again with a lower learning rate or "
            "another seed"
        )
    if depth.isnan().any() or depth.isneginf().any():
        raise unexpected(f"{where}: depth", "z-depths, +inf where nothing is", "NaN or -inf")
    _check_range(rgb, f"{where}: rgb")
    _check_range(alpha, f"{where}: alpha")
    return Frame(rgb, depth, alpha)


def _copied(tensor: object, where: str, shape: tuple[int, ...]) -> Tensor:
    if not isinstance(tensor, Tensor):
        raise unexpected(where, "a torch tensor", type(tensor).__name__)
    if tensor.shape != shape:
        raise unexpected(where, f"shape {list(shape)}", list(tensor.shape))
    if not tensor.is_floating_point():
        how = "floating-point numbers (colours and opacities from 0 to 1: divide bytes by 255)"
        raise unexpected(where, how, str(tensor.dtype))
    return tensor.detach().clone()


def _check_range(tensor: Tensor, where: str) -> None:
    values = tensor.float()
    outside = (values - values.clamp(0, 1)).abs().mean().item()
    negative = (values < NEGATIVE).float().mean().item()
    if not outside <= OUTSIDE or negative > RARE or values.mean() < 0:  # also of NaN
        low, high = values.min().item(), values.max().item()
        got = f"{low:.3g} to {high:.3g}, {outside:.3g} beyond in the mean; divide 0..255 by 255"
        raise unexpected(where, "numbers from 0 to 1", got)


class Shot(NamedTuple):
    """A frame of a path: pictures [H, W, 3] as they are scored; None: not known."""

    image: Tensor
    truth: Tensor | None
    view: video_metrics.DepthView | None


class Scoring:
    """Scores the frames of a sequence in order, alone and against the frames before them.

    `lpips` are the backbones that could be loaded. `surface` is that of the scene: with it, also
    the true pictures have warping errors, `warp_1_true` and `warp_7_true`. Without, flow comes from
    the depth of the frames, and warping errors are called `warp_1_own` and `warp_7_own`. `images`
    holds 8-bit pictures by file name: ground truth, rendering and error map of the `shown` frames,
    once they are scored.
    """

    def __init__(
        self,
        protocol: EvaluationProtocol,
        lpips: Mapping[str, metrics.Lpips],
        background: Tensor,
        shown: Collection[int],
        surface: ByCamera | None = None,
    ) -> None:
        self.images: dict[str, np.ndarray] = {}
        self._protocol, self._lpips, self._scored = protocol, lpips, 0
        self._background, self._shown, self._surface = background, shown, surface
        wanted, own = protocol.columns, "_own" if surface is None else ""
        self._warps = {f"warp_{k}{own}": k for k in video_metrics.OFFSETS if "warp" in wanted}
        self._of_path = [
            *(["tpsnr"] if "tpsnr" in wanted else []),
            *(f"tlpips_{net}" for net in protocol.lpips if "tlpips" in wanted),
            *self._warps,
            *(f"{name}_true" for name in self._warps if not own),
        ]
        # Of the figures of a frame, in their order.
        self.names = (*protocol.metric_names, "flicker", *self._of_path)
        self._last: deque[Shot] = deque(maxlen=1 + max([1, *self._warps.values()]))

    def score(
        self,
        index: int,
        rgb: Tensor,
        truth: Tensor | None,
        *,
        scored: bool = True,
        cut: bool,
        camera: Camera | None = None,
        depth: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> dict[str, float]:
        """The figures of frame `index`, rendered as `rgb` [H, W, 3].

        `truth` is uint8 [H, W, 3 or 4]; that of a frame which is not `scored` serves the path
        alone. `depth` [H, W] is the method's own, `mask` bool [H, W] says which pixels count.
        Frames before a `cut`, or of another size, are not compared with.
        """
        figures: dict[str, float] = {}
        true = None if truth is None else composite(truth.to(rgb.device), self._background)
        shown, mask = rgb, mask if self._protocol.mask == "scene" else None
        if mask is not None and true is not None:
            mask = mask.to(rgb.device)
            rgb = rgb.where(mask[..., None], true)
        if true is not None and scored:
            self._scored += 1
            nets = {} if self._scored % self._protocol.lpips_every else self._lpips
            figures |= self._protocol.score(rgb, true, nets, mask)
            if index in self._shown:
                self.images |= _pictures(index, shown, true)
        view = None
        if camera is not None and self._warps:
            depth = depth if self._surface is None else self._surface(camera)
            view = None if depth is None else video_metrics.DepthView(camera, depth.cpu())
        # On a GPU these would count as memory of the method.
        kept = self._protocol.rounded(rgb).cpu(), None if true is None else true.cpu()
        return figures | self._path(Shot(*kept, view), cut, rgb.device)

    def _path(self, shot: Shot, cut: bool, device: torch.device) -> dict[str, float]:
        """The figures of the next frame against those before it, LPIPS computed on `device`."""
        figures: dict[str, float] = {}
        if cut or (self._last and self._last[-1].image.shape != shot.image.shape):
            self._last.clear()
        before = self._last[-1] if self._last else None
        self._last.append(shot)
        if shot.truth is not None and before is not None and before.truth is not None:
            pictures = shot.image, shot.truth, before.image, before.truth
            figures |= self._step(*(picture.to(device) for picture in pictures))
        for name, offset in self._warps.items():
            then = self._last[-1 - offset] if len(self._last) > offset else None
            if then is not None and then.view is not None and shot.view is not None:
                now, old = shot.view, then.view
                figures[name] = video_metrics.warping_error(shot.image, now, then.image, old)
                if self._surface and shot.truth is not None and then.truth is not None:
                    error = video_metrics.warping_error(shot.truth, now, then.truth, old)
                    figures[f"{name}_true"] = error
        return figures

    def _step(self, now: Tensor, true: Tensor, old: Tensor, true_old: Tensor) -> dict[str, float]:
        """The figures of a frame and its truth, and those of the frame before.

        tPSNR is the PSNR of the change from frame to frame, tLPIPS the absolute difference of its
        LPIPS from that of the truth: tLP of Chu et al. 2020 (TecoGAN), who print 100 times as much.
        """
        figures = {"flicker": metrics.flicker(now, true, old, true_old)}
        if "tpsnr" in self._protocol.columns:
            figures["tpsnr"] = metrics.psnr_of_mse(figures["flicker"] ** 2)
        for net, lpips in self._lpips.items() if "tlpips" in self._protocol.columns else ():
            figures[f"tlpips_{net}"] = abs(lpips(old, now) - lpips(true_old, true))
        return figures

    def missing(self, found: Collection[str]) -> dict[str, str]:
        """Why wanted metrics are not among those `found`, but for networks that are not there."""
        needs = {name: video_metrics.NEEDS[name.split("_")[0]] for name in self._of_path}
        why = {name: f"needs {what}" for name, what in needs.items() if name not in found}
        every = self._protocol.lpips_every
        if self._scored in range(1, every):
            have = f"the path has {self._scored} frames to score"
            few = f"protocol.lpips_every is {every}, and {have}"
            why |= {f"lpips_{net}": few for net in self._lpips}
        return why


def _pictures(index: int, rgb: Tensor, truth: Tensor) -> dict[str, np.ndarray]:
    """Ground truth, rendering and error map of a frame, as 8-bit pictures by file name."""
    import matplotlib  # imported here: it takes 0.3 s, needed only for pictures

    rendering, truth = metrics.quantise(rgb).cpu(), truth.cpu()
    error = (rendering - truth).abs().mean(dim=-1) / ERROR_RANGE
    of_error = matplotlib.colormaps["inferno"](error.numpy(), bytes=True)[..., :3]
    return {
        f"{index:04d}-truth": metrics.as_bytes(truth),
        f"{index:04d}-rendered": metrics.as_bytes(rendering),
        f"{index:04d}-error": of_error,
    }
