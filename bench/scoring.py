"""Scores of rendered frames by a protocol, one after the other, with pictures of some of them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping

import numpy as np
import torch
from torch import Tensor

from bench import metrics, video_metrics
from bench.protocol import EvaluationProtocol
from bench.types import Camera, Frame, SteerbenchError, check_shape, composite

PICTURES = 3  # default number of scored frames whose pictures are kept
ERROR_RANGE = 0.1  # mean absolute error of the brightest colour of an error map


def check_frame(frame: Frame, camera: Camera, method: str, index: int) -> None:
    """Raise SteerbenchError if a pixel is not finite, ValueError if the size is not `camera`'s."""
    check_shape("rgb", frame.rgb, camera.height, camera.width, 3)
    broken = int((~torch.isfinite(frame.rgb)).any(dim=-1).sum())
    if broken:
        raise SteerbenchError(
            f"{method} rendered {broken} of {camera.height * camera.width} pixels of frame {index} "
            "as NaN or infinite: the training is broken; train again with a lower learning rate or "
            "another seed"
        )


class Scoring:
    """Scores the frames of a sequence in order, alone and against the frames before them.

    `surface` is that of the scene: without it, flow comes from the depth of the frames. `images`
    holds 8-bit pictures by file name: ground truth, rendering and error map of the `shown` frames,
    once they are scored.
    """

    def __init__(
        self,
        protocol: EvaluationProtocol,
        lpips: Mapping[str, metrics.Lpips],
        background: Tensor,
        shown: Collection[int],
        surface: Callable[[Camera], Tensor] | None = None,
    ) -> None:
        self.images: dict[str, np.ndarray] = {}
        self._protocol, self._lpips, self._scored = protocol, lpips, 0
        self._background, self._shown, self._surface = background, shown, surface
        self.path = video_metrics.PathScoring(
            protocol.columns, protocol.lpips, lpips, exact_flow=surface is not None
        )
        self.names = (*protocol.metric_names, *self.path.names)  # of a frame's figures, in order

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
    ) -> dict[str, float]:
        """The figures of frame `index`, rendered as `rgb` [H, W, 3].

        `truth` is uint8 [H, W, 3 or 4]; that of a frame which is not `scored` serves the path
        alone. `depth` [H, W] is the method's own. Frames before a `cut`, or of another size, are
        not compared with.
        """
        figures: dict[str, float] = {}
        true = None if truth is None else composite(truth.to(rgb.device), self._background)
        if truth is not None and true is not None and scored:
            self._scored += 1
            nets = {} if self._scored % self._protocol.lpips_every else self._lpips
            figures |= self._protocol.score(rgb, truth, self._background, nets)
            if index in self._shown:
                self.images |= _pictures(index, rgb, true)
        view = None
        if camera is not None and self.path.warps:
            depth = depth if self._surface is None else self._surface(camera)
            view = None if depth is None else video_metrics.DepthView(camera, depth.cpu())
        # On a GPU these would count as memory of the method.
        kept = self._protocol.rounded(rgb).cpu(), None if true is None else true.cpu()
        return figures | self.path.add(video_metrics.Shot(*kept, view), cut, rgb.device)

    def missing(self, found: Collection[str]) -> dict[str, str]:
        """Why wanted metrics are not among those `found`, but for networks that are not there."""
        every = self._protocol.lpips_every
        if self._scored not in range(1, every):
            return self.path.missing(found)
        why = f"protocol.lpips_every is {every}, and the path has {self._scored} frames to score"
        return {**self.path.missing(found), **{f"lpips_{net}": why for net in self._lpips}}

    def whole(self) -> dict[str, float]:
        """The figures of the whole sequence."""
        return self.path.whole(self._protocol.fps, self._protocol.display)


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
