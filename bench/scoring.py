"""Scores a sequence frame by frame, so that frames need not be kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.compositing import composite
from bench.metrics import Lpips, as_bytes, flicker, quantise
from bench.protocol import EvaluationProtocol
from bench.trajectories import Step, Trajectory, spread
from bench.types import Camera, Frame, Scene, SteerbenchError, check_shape

PICTURES = 3
"""Default number of scored frames whose pictures are kept."""

ERROR_RANGE = 0.1
"""Absolute error (mean over channels) that the brightest colour of an error map stands for."""


def check_frame(frame: Frame, camera: Camera, method: str, index: int) -> None:
    """Raise if a frame cannot be scored: wrong size, or values that are not finite.

    Raises:
        ValueError: the size differs from that of `camera`.
        SteerbenchError: a pixel is not finite.
    """
    check_shape("rgb", frame.rgb, camera.height, camera.width, 3)
    broken = int((~torch.isfinite(frame.rgb)).any(dim=-1).sum())
    if broken:
        raise SteerbenchError(
            f"{method} rendered {broken} of {camera.height * camera.width} pixels of frame {index} "
            "as NaN or infinite: the training is broken; train again with a lower learning rate or "
            "another seed"
        )


class Flicker:
    """Scores the flicker of each frame against the previous one, which it keeps."""

    def __init__(self) -> None:
        self._last: tuple[Tensor, Tensor] | None = None

    def since_last(
        self, frame: tuple[Tensor, Tensor] | None, cut: bool = False
    ) -> dict[str, float]:
        """The flicker from the previous frame to this one.

        `frame` is a rendering and its true picture, both [H, W, 3]; None: it has no truth. Empty
        after a `cut`, and if either frame has no truth or their sizes differ.
        """
        if frame is not None:  # on the GPU it would count as memory of the method
            frame = frame[0].cpu(), frame[1].cpu()
        last, self._last = self._last, frame
        if cut or last is None or frame is None or last[0].shape != frame[0].shape:
            return {}
        return {"flicker": flicker(*frame, *last)}


class Scoring:
    """Scores the frames of a trajectory in order; keeps the last one for the flicker.

    Attributes:
        images: 8-bit pictures by file name: ground truth, rendering and error map of some evenly
            spread scored frames. Filled while frames are scored.
    """

    def __init__(
        self,
        scene: Scene,
        trajectory: Trajectory,
        protocol: EvaluationProtocol,
        lpips: Mapping[str, Lpips],
        pictures: int = PICTURES,
    ) -> None:
        self.images: dict[str, np.ndarray] = {}
        self._scene, self._protocol, self._lpips = scene, protocol, lpips
        self._split = scene.splits[trajectory.split]
        scored = [index for index, step in enumerate(trajectory.steps) if step.truth is not None]
        self._shown = {scored[i] for i in spread(len(scored), pictures)}
        self._flicker = Flicker()

    def score(self, index: int, step: Step, rgb: Tensor) -> dict[str, Any]:
        """Name and metrics of frame `index`, rendered as `rgb` [H, W, 3]; none without truth."""
        figures: dict[str, Any] = {}
        background, pair, truth = self._scene.background, None, None
        if step.truth is not None:
            truth = self._split.images[step.truth]
            figures["name"] = self._split.names[step.truth]
            figures |= self._protocol.score(rgb, truth, background, self._lpips)
            if index in self._shown:
                self.images |= kept_pictures(index, rgb, composite(truth, background))
        elif self._protocol.flicker == "exact" and self._scene.exact is not None:
            truth = self._scene.exact(step.camera)
        if truth is not None:
            pair = self._protocol.rounded(rgb), composite(truth.to(rgb.device), background)
        return figures | self._flicker.since_last(pair, step.cut)


def kept_pictures(index: int, rgb: Tensor, truth: Tensor) -> dict[str, np.ndarray]:
    """Ground truth, rendering and error map of a frame, as 8-bit pictures by file name."""
    import matplotlib  # imported here: it takes 0.3 s, needed only for pictures

    rendering, truth = quantise(rgb).cpu(), truth.cpu()
    error = (rendering - truth).abs().mean(dim=-1) / ERROR_RANGE
    return {
        f"{index:04d}-truth": as_bytes(truth),
        f"{index:04d}-rendered": as_bytes(rendering),
        f"{index:04d}-error": matplotlib.colormaps["inferno"](error.numpy(), bytes=True)[..., :3],
    }
