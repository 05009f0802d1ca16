"""Training sequences: a true picture, and the frames that came before it.

Training views are scattered, so the preceding cameras are synthetic: a random smooth motion that
ends at the view. The pipeline renders these frames with its present weights, as it does when it is
used. After a number of patches they are rendered again, along another motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from collections.abc import Sequence as Seq
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.motion import preceding, viewing_target
from bench.types import Camera, Scene
from methods.steernerf.buffer import RenderingBuffer
from methods.steernerf.options import Rendering
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.view import View
from methods.training.checkpoint import part


@dataclass(frozen=True)
class TrueView:
    """A `camera` and its `picture`, uint8 [H, W, 3 or 4]."""

    camera: Camera
    picture: Tensor


@dataclass(frozen=True)
class TrainingViews:
    """The views of a scene that a 2D renderer learns from.

    Attributes:
        real: the training pictures.
        target: [3] the point that the cameras look at, roughly.
        distilled: views whose pictures a trained field has rendered.
        share: share of the sequences that end in a distilled view.
    """

    real: Seq[TrueView]
    target: Tensor
    distilled: Seq[TrueView] = ()
    share: float = 0.0

    @classmethod
    def of(cls, scene: Scene, distilled: Seq[TrueView] = (), share: float = 0.0) -> TrainingViews:
        """The training views of `scene`, and `distilled` ones for a `share` of the sequences."""
        split = scene.splits["train"]
        real = [TrueView(c, p) for c, p in zip(split.cameras, split.images, strict=True)]
        return cls(real, viewing_target(scene), distilled, share)

    @property
    def all(self) -> Seq[TrueView]:
        """The real views, then the distilled ones."""
        return [*self.real, *self.distilled]


@dataclass
class Sequence:
    """A training view and the frames that precede it.

    Attributes:
        number: index of the view among those of its pool.
        truth: the view and its picture.
        view: the view as the pipeline sees it.
        buffer: the preceding frames.
        cells: [N, 2] row and column of the low-resolution pixels that show more than background;
            of all pixels if none does.
        uses: how many patches may still be cut from it.
        lasting: whether it is then continued instead of replaced.
    """

    number: int
    truth: TrueView
    view: View
    buffer: RenderingBuffer
    cells: Tensor
    uses: int
    lasting: bool


@dataclass(frozen=True)
class MotionOptions:
    """The synthetic motions before a training view.

    Attributes:
        degrees: range of the angular speed, in degrees per frame.
        length: maximum number of frames that precede a view.
        least: minimum number; fewer than L, and sometimes none, teach the cold start. The release
            always trains with L.
        pool: number of sequences kept at a time.
        uses: patches cut from a sequence before it is replaced.
        longer: probability that it is continued instead, there and back to its view, so that what
            is drawn becomes its own history.
    """

    degrees: tuple[float, float] = (0.0, 2.5)
    length: int = 4
    least: int = 0
    pool: int = 12
    uses: int = 16
    longer: float = 0.75

    def __post_init__(self) -> None:
        low, high = self.degrees
        if not (0 <= low <= high and 0 <= self.least <= self.length):
            raise ValueError(
                f"expected 0 <= degrees[0] <= degrees[1] and 0 <= least <= length: {self}"
            )
        if not (self.pool >= 1 and self.uses >= 1):
            raise ValueError(f"expected pool and uses of 1 or more: {self}")
        if not 0 <= self.longer < 1:
            raise ValueError(f"longer: expected a share from 0 to less than 1, got {self.longer}")


class SequencePool:
    """Sequences that end in randomly chosen views and are replaced as `MotionOptions` says.

    Args:
        pipeline: renders the frames that precede a view.
        rendering: how it renders them.
        views: the views that sequences end in.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        rendering: Rendering,
        views: TrainingViews,
        options: MotionOptions,
        generator: torch.Generator,
    ) -> None:
        self.pipeline, self.rendering = pipeline, rendering
        self._views, self._options, self._generator = views, options, generator
        self._pool: list[Sequence] = []
        background = pipeline.background[:3].cpu()  # read back once: the host waits for a GPU
        self._background = (background * 255).round().to(torch.uint8)

    def draw(self) -> Sequence:
        """Draw a sequence from the pool; counts as one use."""
        place = self._random(self._options.pool)
        if place >= len(self._pool):
            self._pool.append(self._make())
            place = len(self._pool) - 1
        elif self._pool[place].uses <= 0:
            old = self._pool[place]
            self._pool[place] = self._go_on(old) if old.lasting else self._make()
        sequence = self._pool[place]
        sequence.uses -= 1
        return sequence

    def state(self) -> dict[str, Tensor]:
        """The state of all sequences, to be kept in a file."""
        tensors = {}
        for place, sequence in enumerate(self._pool):
            figures = (sequence.number, sequence.uses, sequence.lasting)
            tensors[f"{place}.figures"] = torch.tensor(figures)
            tensors |= {f"{place}.{name}": x for name, x in sequence.buffer.state().items()}
        return tensors

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore the sequences that `state` of a pool with the same views and options returned."""
        count = sum(name.endswith(".figures") for name in tensors)
        self._pool = [self._restored(part(tensors, f"{place}.")) for place in range(count)]

    def _restored(self, tensors: Mapping[str, Tensor]) -> Sequence:
        number, uses, lasting = tensors["figures"].tolist()
        buffer = RenderingBuffer(self.pipeline.model.frames)
        buffer.restore(tensors, self.pipeline.background.device)
        cells = self._cells(self._views.all[number].picture)
        return self._sequence(number, buffer, cells, uses, bool(lasting))

    def _make(self) -> Sequence:
        views = self._views
        distilled = self._chance() < (views.share if views.distilled else 0.0)
        first, pictures = (len(views.real), views.distilled) if distilled else (0, views.real)
        number = first + self._random(len(pictures))
        buffer = RenderingBuffer(self.pipeline.model.frames)
        view = views.all[number]
        cells = self._cells(view.picture)
        return self._ended(number, self._motion(view), buffer, cells)

    def _go_on(self, old: Sequence) -> Sequence:
        """Continue from the view that `old` ends in, there and back."""
        back = self._motion(old.truth)
        back = back[len(back) // 2 :]
        path = [old.truth.camera, *reversed(back), *back[1:]]
        return self._ended(old.number, path, old.buffer.copy(), old.cells)

    def _motion(self, truth: TrueView) -> list[Camera]:
        options = self._options
        count = options.least + self._random(options.length - options.least + 1)
        return preceding(truth.camera, self._views.target, count, options.degrees, self._generator)

    def _ended(
        self, number: int, motion: Seq[Camera], buffer: RenderingBuffer, cells: Tensor
    ) -> Sequence:
        """Make a sequence after rendering the frames of a `motion` into its `buffer`."""
        if self.pipeline.model.frames:
            for camera in motion:
                self.pipeline.remember(camera, buffer, self.rendering)
        # Without preceding frames, continuing would only repeat the view.
        lasting = self._chance() < self._options.longer and self.pipeline.model.frames > 0
        return self._sequence(number, buffer, cells, self._options.uses, lasting)

    def _sequence(
        self, number: int, buffer: RenderingBuffer, cells: Tensor, uses: int, lasting: bool
    ) -> Sequence:
        truth = self._views.all[number]
        view = self.pipeline.view(truth.camera)
        return Sequence(number, truth, view, buffer, cells, uses, lasting)

    def _chance(self) -> float:
        return torch.rand((), generator=self._generator).item()

    def _random(self, below: int) -> int:
        return int(torch.randint(below, (), generator=self._generator))

    def _cells(self, picture: Tensor) -> Tensor:
        """See `Sequence.cells`."""
        scale = self.pipeline.model.scale
        if picture.shape[-1] == 4:
            content = picture[..., 3] > 0
        else:
            content = (picture != self._background).any(dim=-1)
        height, width = (-(-side // scale) for side in content.shape)
        cells = torch.zeros(height, width, dtype=torch.bool)
        rows, columns = content.nonzero().unbind(dim=1)
        cells[rows // scale, columns // scale] = True
        return cells.nonzero() if cells.any() else (~cells).nonzero()
