"""The interfaces between the benchmark and the methods it measures, and the glossary of symbols.

| symbol   | meaning                                             | unit, shape, axes                     |
|----------|-----------------------------------------------------|---------------------------------------|
| c2w      | camera-to-world, OpenCV axes (x right, y down, z forward) | [3, 4], scene units             |
| fx fy cx cy | intrinsics                                       | pixels; pixel (i, j) spans [i, i+1) x [j, j+1), centre at +0.5 |
| o, d     | ray origin and direction; d has camera z = 1        | [R, 3], so t below is z-depth         |
| t        | position along a ray, o + t d                       | z-depth, scene units                  |
| sigma    | volume density                                      | 1 / scene unit                        |
| delta    | length of a sample's interval, t-step * norm(d)     | scene units                           |
| alpha    | opacity, 1 - exp(-sigma delta) of a sample or sum w of a ray | [0, 1]                       |
| T        | transmittance in front of a sample                  | [0, 1]                                |
| w        | T * alpha, the weight of a sample                   | [0, 1]                                |
| rgb      | colour, linear in the stored sRGB values            | [H, W, 3], [0, 1]                     |
| depth    | sum w t / sum w; +inf where alpha is below `EMPTY_ALPHA` | [H, W], scene units              |
| K        | channels of a feature map, the first three are RGB  |                                       |
| L        | preceding frames a method with memory looks back on |                                       |

Scene units: every scene is normalised so that its content lies in the unit cube [0, 1]^3;
`Scene.unit_length` converts a length back to the data set's own unit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor

from bench.errors import SteerbenchError as SteerbenchError
from bench.errors import Unavailable as Unavailable
from bench.errors import unexpected
from bench.kinds import Size

TwoTensors = tuple[Tensor, Tensor]
SomeTensors = Sequence[Tensor]
ThreeTensors = tuple[Tensor, Tensor, Tensor]

EMPTY_ALPHA = 1e-3  # pixels with a lower opacity are empty: their depth is +inf
BACKGROUNDS = {"white": 1.0, "black": 0.0}  # by name, every channel of `Scene.background`
DEVICE = re.compile(r"auto|cpu|cuda(:\d+)?")  # valid names; `auto` is the GPU if there is one


def check_shape(name: str, value: Tensor, *shape: int | None) -> None:
    """Raise `ValueError` unless `value` has `shape`; None stands for any size along that axis."""
    got = list(value.shape)
    if len(got) != len(shape) or any(s not in (None, g) for s, g in zip(shape, got, strict=True)):
        want = ", ".join("any" if size is None else str(size) for size in shape)
        raise ValueError(f"{name}: expected shape [{want}], got {got}")


def rows(table: Tensor, index: Tensor | slice) -> Tensor:
    """The rows of a `table` at `index`, one at a time; `table[index]` goes number by number."""
    return table[index] if isinstance(index, slice) else table.index_select(0, index)


def composite(picture: Tensor, background: Tensor) -> Tensor:
    """Composite an 8-bit `picture` [H, W, 3 or 4] onto `background` [3]; float [H, W, 3]. Raises
    SteerbenchError if it has other numbers."""
    if picture.dtype != torch.uint8:
        raise unexpected("a picture of the scene", "torch.uint8, 0 to 255", picture.dtype)
    values = picture.float() / 255.0
    if values.shape[-1] == 3:
        return values
    rgb, alpha = values[..., :3], values[..., 3:]
    return rgb * alpha + background.to(values) * (1.0 - alpha)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera. `c2w` is [3, 4] float32 in scene units; intrinsics are in pixels."""

    c2w: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def size(self) -> Size:
        """Width and height."""
        return self.width, self.height

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """Focal lengths, then the principal point."""
        return self.fx, self.fy, self.cx, self.cy

    @property
    def rotation(self) -> Tensor:
        """[3, 3], of camera axes in the world."""
        return self.c2w[:, :3]

    @property
    def centre(self) -> Tensor:
        """[3], where the camera is."""
        return self.c2w[:, 3]


Cameras = Sequence[Camera]
ByCamera = Callable[[Camera], Tensor]  # a picture, or a map with its size


@dataclass(frozen=True)
class Rays:
    """`origins` [R, 3] and `directions` [R, 3] with camera z = 1, so that t is z-depth."""

    origins: Tensor
    directions: Tensor

    @classmethod
    def joined(cls, parts: Sequence[Rays]) -> Rays:
        origins, directions = zip(*((rays.origins, rays.directions) for rays in parts), strict=True)
        return cls(torch.cat(origins), torch.cat(directions))

    def take(self, index: Tensor | slice) -> Rays:
        return Rays(rows(self.origins, index), rows(self.directions, index))


@dataclass(frozen=True)
class Frame:
    """One rendered picture: `rgb` [H, W, 3], `depth` [H, W] (+inf where empty), `alpha` [H, W]."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor


@dataclass(frozen=True)
class Split:
    """Cameras and their pictures, `images[n]` uint8 [H, W, 3 or 4] (4: straight alpha). `masks`,
    if any, say which pixels count, bool [H, W]; None: all of that picture."""

    cameras: Cameras
    images: SomeTensors
    names: Sequence[str]
    masks: Sequence[Tensor | None] = ()

    def __len__(self) -> int:
        return len(self.cameras)

    def mask(self, number: int) -> Tensor | None:
        """The mask of a picture, None if all of its pixels count."""
        return self.masks[number] if self.masks else None


@dataclass(frozen=True)
class Scene:
    """Everything a method may learn from and everything it is scored on.

    A point of the data set is origin + unit_length * scene point, with the same axes. `space` is
    "box" if there is nothing outside the unit cube, or "all": what is seen goes on to infinity, and
    the middle half of the cube is the part that deserves most detail. `exact`
    renders the true picture of any camera as in a split, `surface` its z-depth [H, W] at the centres
    of pixels, +inf where empty; None if the scene cannot, or has no opaque surface. `maps` are
    similarities [4, 4] float64 from the coordinates that another program, of that name, shows to
    those of the data set.
    """

    name: str  # as shown in result rows
    splits: Mapping[str, Split]  # "train" and "test" at least
    background: Tensor  # [3] in [0, 1], onto which RGBA pictures and predictions are composited
    bounds: Tensor  # [2, 3] lower and upper corner of the content, inside the unit cube
    unit_length: float  # of one scene unit, in the data set's own unit
    digest: str  # content hash of cameras, pictures and normalisation
    origin: Tensor = field(default_factory=lambda: torch.zeros(3).double())  # float64
    space: str = "box"
    exact: ByCamera | None = None
    surface: ByCamera | None = None
    maps: Mapping[str, Tensor] = field(default_factory=dict)
    files: tuple[Path, ...] = ()  # that it was read from

    @property
    def cells(self) -> Tensor:
        """[2, 3] lower and upper corner of the part of the unit cube that may hold matter, if all
        of space is contracted into it."""
        return self.bounds if self.space == "box" else torch.tensor([[0.0] * 3, [1.0] * 3])


@dataclass(frozen=True)
class Budget:
    """How much work a training may do, in steps rather than seconds so that it is repeatable.

    `samples`, of which a training may take a share, sets the number of rays. `renderer_steps` are
    of what is trained after the field: a 2D renderer, Gaussians, what starts from the field.
    """

    name: str  # as shown in result rows
    steps: int  # of the optimiser, in the (pre-)training of a field
    samples: int  # of a field with a gradient, per step
    frames: int = 0  # at most so many test frames are rendered and scored; 0: all
    renderer_steps: int = 1
    threads: int | None = None  # of the CPU, for one training; None: as many as torch uses

    def __post_init__(self) -> None:
        if min(self.steps, self.samples, self.renderer_steps) < 1 or self.frames < 0:
            raise ValueError(f"expected steps, samples, renderer_steps >= 1, frames >= 0: {self}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"threads: expected 1 or more, or none, got {self.threads}")


class Log(Protocol):
    """The log of a training: messages, progress with the time left, folders of its stages."""

    def info(self, message: str) -> None:
        """Show one line to the user."""

    def progress(self, label: str, total: int) -> AbstractContextManager[Progress]:
        """A progress bar with the time left, for work of `total` steps."""

    def stage_dir(self, kind: str, key: Mapping[str, object]) -> Path:
        """The folder of a trained stage, `outputs/stages/<kind>-<hash of key>`; made if missing."""


class Progress(Protocol):
    """A running progress bar."""

    def advance(self, steps: int = 1, note: str = "") -> None:
        """Count `steps` as done; `note` is a short figure shown beside the bar ("31.2 dB")."""


class Probe(Protocol):
    """Owns every clock and counter of a measurement; passed to a method with every frame."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        """Time a stage. Synchronises the device; a stage may be entered many times a frame."""

    def count(self, name: str, done: int | Tensor, dense: int | None = None) -> None:
        """Add `done` units of work; `dense` is the work of a method that skips nothing.

        A count on a GPU, given as a tensor of one number, is read at the end of the frame.
        """

    def report(
        self,
        ns: int,
        stages_ns: Mapping[str, int],
        peak_bytes: int | None = None,
        transfer_ns: int = 0,
    ) -> None:
        """Take the time of this frame, in all and of its stages, from the clock of another process,
        whose picture has just arrived, and the peak of that process's memory, if known.

        `transfer_ns` is how long the picture took to arrive. Raises SteerbenchError if less time
        than `ns` has passed here since the frame began.
        """


class Method(Protocol):
    """A radiance-field renderer.

    `train_s` are the seconds of training, summed over all processes that continued it; `fit` sets
    them even if it only loads. It may also set `train_peak_bytes`, the peak of memory meanwhile, and
    `compile_s`, the seconds of compiling before the training, which are not among those of it.

    If `sees_scored` is true, `fit` is given all splits and the exact pictures, which rows say;
    otherwise the training split alone. `decided(scene)`, if there is one, says what settings that a
    scene decides become for it, by the names that one types.
    """

    name: str  # as shown in result rows
    train_s: float
    memory: int  # preceding frames that it uses; 0: every frame is rendered independently

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train, or load the stages that an earlier training with the same key stored."""

    def reset(self) -> None:
        """Forget preceding frames: a new sequence starts."""

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """Render one frame of the current sequence."""

    def sizes(self) -> dict[str, int]:
        """Bytes by component, as stored in a file of the model."""

    def settings(self) -> dict[str, str]:
        """The resolved `device`, `backend`, `engine`, `precision` and `field_precision`, which rows
        show as docs/protocol.md explains."""


class NullProbe:
    """A probe that measures nothing, for when only pictures are wanted."""

    def stage(self, name: str) -> AbstractContextManager[None]:
        return nullcontext()

    def count(self, name: str, done: int | Tensor, dense: int | None = None) -> None:
        pass

    def report(self, *told: object, **more: object) -> None:
        pass
