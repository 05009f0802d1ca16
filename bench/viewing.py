"""The rendering side of a viewer: one frame at a time, each browser's newest camera only."""

import threading
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bench.cameras import scale_camera
from bench.clock import OTHER, StageClock
from bench.isolation import lent
from bench.metrics import quantise
from bench.scoring import taken
from bench.types import Camera, Method

COARSE = 2  # while a camera moves, a slow method renders so many times fewer pixels a side
FLUENT_MS = 100.0  # a method is slow if a frame takes longer: the user notices the lag


@dataclass(frozen=True)
class Ask:
    """A request for a picture by a browser; `still` if its camera has stopped."""

    camera: Camera
    still: bool = False


class Turns:
    """The queue of browsers that wait for a picture, in the order in which they began to wait."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, Ask] = {}
        self._changed = threading.Condition()

    def want(self, who: Hashable, ask: Ask) -> None:
        """Request a picture for `who`, replacing any pending request."""
        with self._changed:
            self._waiting[who] = ask
            self._changed.notify_all()

    def offer(self, who: Hashable, ask: Ask) -> None:
        """Request a picture for `who` unless a request is already pending."""
        with self._changed:
            self._waiting.setdefault(who, ask)

    def forget(self, who: Hashable) -> None:
        """Drop any pending request of `who`, which has disconnected."""
        with self._changed:
            self._waiting.pop(who, None)

    def next(self, timeout: float | None = None) -> tuple[Hashable, Ask] | None:
        """Take the longest-waiting browser and its request; None after `timeout` idle seconds."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._waiting, timeout):
                return None
            who = next(iter(self._waiting))
            return who, self._waiting.pop(who)


@dataclass(frozen=True)
class Drawn:
    rgb: Tensor  # [H, W, 3] in [0, 1], on the CPU, rounded to 8 bits
    ms: float  # of the frame
    stages_ms: dict[str, float]  # of each stage without nested stages, longest first


class Painter:
    """Renders the pictures that several browsers want, each with all methods.

    Methods are reset when the browser or the picture size changes: another sequence begins.
    """

    def __init__(self, methods: Sequence[Method]) -> None:
        self.methods = list(methods)
        self._sequence: tuple[Hashable, int, int] | None = None
        self._full_ms: dict[int, float] = {}  # of the latest frame, by its number of pixels

    def put(self, place: int, method: Method) -> None:
        self.methods[place] = method
        self._sequence = None
        self._full_ms.clear()

    def sized(self, ask: Ask) -> Camera:
        """The camera to render: coarser if the methods are too slow for a moving camera."""
        camera = ask.camera
        took = self._full_ms.get(camera.width * camera.height, 0.0)
        if ask.still or took <= FLUENT_MS:
            return camera
        return scale_camera(camera, -(-camera.width // COARSE), -(-camera.height // COARSE))

    @torch.no_grad()
    def draw(self, who: Hashable, camera: Camera) -> list[Drawn]:
        """Render `camera` with each method; SteerbenchError if values are not finite."""
        sequence = (who, *camera.size)
        if sequence != self._sequence:
            for method in self.methods:
                method.reset()
            self._sequence = sequence
        drawn = []
        for method in self.methods:
            clock = StageClock(method.settings()["device"])
            with clock.frame():
                frame = method.render(lent(camera), clock)
            frame = taken(frame, camera, method.name, 0)
            (record,) = clock.frames
            parts = record.stages_ns.items()
            times = {name: ns / 1e6 for name, ns in parts if ns or name != OTHER}
            stages = dict(sorted(times.items(), key=lambda item: -item[1]))
            rgb = quantise(frame.rgb.cpu())
            drawn.append(Drawn(rgb, record.total_ns / 1e6, stages))
        self._full_ms[camera.width * camera.height] = sum(picture.ms for picture in drawn)
        return drawn


def divided(left: Tensor, right: Tensor, at: float) -> Tensor:
    """`left` and `right` [H, W, 3] in one picture, split by a line at share `at` of the width."""
    column = round(at * left.shape[1])
    both = torch.cat((left[:, :column], right[:, column:]), dim=1)
    both[:, max(column - 1, 0) : column + 1] = 0.5
    return both


def difference(first: Tensor, second: Tensor) -> Tensor:
    """|first - second|, amplified by 4 to make it visible; [H, W, 3] in [0, 1]."""
    return (4 * (first - second).abs()).clamp(0, 1)


def seen_from(
    rotation: np.ndarray, position: np.ndarray, fov: float, width: int, height: int
) -> Camera:
    """The camera at `position` [3] with a vertical field of view of `fov` radians.

    `rotation` [3, 3] is camera-to-world, in OpenCV axes.
    """
    c2w = torch.from_numpy(np.concatenate((rotation, position[:, None]), axis=1)).float()
    focal = height / 2 / float(np.tan(fov / 2))
    return Camera(c2w, focal, focal, width / 2, height / 2, width, height)
