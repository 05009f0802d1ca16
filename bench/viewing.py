"""What a viewer draws: for each browser the newest camera that it wants, one frame at a time."""

from __future__ import annotations

import threading
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.cameras import scale_camera
from bench.metrics import quantise
from bench.probes import OTHER, StageClock
from bench.scoring import check_frame
from bench.types import Camera, Method

COARSE = 2
"""While a camera moves, a slow method draws so many times fewer pixels along both axes."""

FLUENT_MS = 100.0
"""A method that needs longer for a frame is slow: a moving hand notices."""


@dataclass(frozen=True)
class Ask:
    """A picture that a browser wants; a `still` one is of a camera that has stopped."""

    camera: Camera
    still: bool = False


class Turns:
    """Who waits for a picture, in the order in which they began to wait.

    Only the newest that someone asked for counts: pictures are dropped, they never queue.
    """

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Ask] = {}
        self._changed = threading.Condition()

    def want(self, who: Hashable, ask: Ask) -> None:
        """Ask for a picture instead of the one that `who` is waiting for."""
        with self._changed:
            self._waiting[who] = ask
            self._changed.notify_all()

    def offer(self, who: Hashable, ask: Ask) -> None:
        """Ask for a picture unless `who` is waiting for another one."""
        with self._changed:
            self._waiting.setdefault(who, ask)

    def forget(self, who: Hashable) -> None:
        """`who` has gone."""
        with self._changed:
            self._waiting.pop(who, None)

    def next(self, timeout: float | None = None) -> tuple[Hashable, Ask] | None:
        """Who has waited longest, and for what; None where nobody came for `timeout` seconds."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._waiting, timeout):
                return None
            who = next(iter(self._waiting))
            return who, self._waiting.pop(who)


@dataclass(frozen=True)
class Drawn:
    """A picture of a method.

    Attributes:
        rgb: [H, W, 3] in [0, 1], on the CPU, with the 256 values of a file.
        ms: that the frame took.
        stages_ms: own time of each stage, the longest first.
    """

    rgb: Tensor
    ms: float
    stages_ms: dict[str, float]


class Painter:
    """Draws with several methods what several browsers want.

    A method with memory forgets when it draws for another browser, or at another size: its
    preceding frames are then of another sequence.
    """

    def __init__(self, methods: Sequence[Method]) -> None:
        self.methods = list(methods)
        self._sequence: tuple[Hashable, int, int] | None = None
        self._full_ms: dict[int, float] = {}  # of the last frame, by its pixels

    def put(self, place: int, method: Method) -> None:
        """Replace a method."""
        self.methods[place] = method
        self._sequence = None
        self._full_ms.clear()

    def sized(self, ask: Ask) -> Camera:
        """The camera to draw with: coarser where the methods are too slow for one that moves."""
        camera = ask.camera
        took = self._full_ms.get(camera.width * camera.height, 0.0)
        if ask.still or took <= FLUENT_MS:
            return camera
        return scale_camera(camera, -(-camera.width // COARSE), -(-camera.height // COARSE))

    @torch.no_grad()
    def draw(self, who: Hashable, camera: Camera) -> list[Drawn]:
        """The picture of each method.

        Raises:
            SteerbenchError: a method gave something that is no frame.
        """
        sequence = (who, camera.width, camera.height)
        if sequence != self._sequence:
            for method in self.methods:
                method.reset()
            self._sequence = sequence
        drawn = [_drawn(method, camera) for method in self.methods]
        self._full_ms[camera.width * camera.height] = sum(one.ms for one in drawn)
        return drawn


def _drawn(method: Method, camera: Camera) -> Drawn:
    clock = StageClock(method.settings()["device"])
    with clock.frame():
        frame = method.render(camera, clock)
    check_frame(frame, camera, method.name, 0)
    (record,) = clock.frames
    times = {name: ns / 1e6 for name, ns in record.stages_ns.items() if name != OTHER or ns}
    stages = dict(sorted(times.items(), key=lambda item: -item[1]))
    return Drawn(quantise(frame.rgb.cpu()), record.total_ns / 1e6, stages)


def divided(left: Tensor, right: Tensor, at: float) -> Tensor:
    """The first picture on the left of share `at` of the width, the other one on the right, with a
    line between them; [H, W, 3] each."""
    column = round(at * left.shape[1])
    both = torch.cat((left[:, :column], right[:, column:]), dim=1)
    both[:, max(column - 1, 0) : column + 1] = 0.5
    return both


def difference(one: Tensor, other: Tensor, gain: float = 4.0) -> Tensor:
    """|one - other|, `gain` times as large so that it shows; [H, W, 3] in [0, 1]."""
    return (gain * (one - other).abs()).clamp(0, 1)


def seen_from(
    rotation: np.ndarray, position: np.ndarray, fov: float, width: int, height: int
) -> Camera:
    """The camera at `position` [3], with `rotation` [3, 3] to the world (OpenCV axes) and a field
    of view of `fov` radians from top to bottom."""
    c2w = torch.from_numpy(np.concatenate((rotation, position[:, None]), axis=1)).float()
    focal = height / 2 / float(np.tan(fov / 2))
    return Camera(c2w, focal, focal, width / 2, height / 2, width, height)
