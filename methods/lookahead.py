"""The field of the next frame beside the rest of this one, where the next camera is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from bench.types import Camera, Frame, NullProbe, Probe
from methods.buffer import Cloud, RenderingBuffer
from methods.pipeline import Glance, Pipeline


@dataclass(frozen=True)
class Prospect:
    """A `glance` at a frame that is not asked for yet, from `camera`, and the work it took."""

    camera: Camera
    glance: Glance
    work: Ledger


class Lookahead:
    """Renders the frames of a sequence, of each its glance beside the rest of the one before it.

    While both are at work each has half of the CPU's threads. A stage seldom takes half the time on
    twice as many, for they wait for each other at the end of each of its loops; so two frames at a
    time take less than two frames one after the other.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="lookahead")
        self._upcoming: Camera | None = None
        self._prospect: Prospect | None = None

    def foresee(self, camera: Camera) -> None:
        """The frame after the next one to be rendered will be that of `camera`."""
        self._upcoming = camera

    def forget(self) -> None:
        """A new sequence starts."""
        self._upcoming = self._prospect = None

    def render(
        self, pipeline: Pipeline, camera: Camera, buffer: RenderingBuffer, probe: Probe
    ) -> Frame:
        """The frame of `Pipeline.render`, and a glance at the one that was foreseen, if any.

        The glance has ended when this returns, the time that it is waited for is the stage
        `lookahead`, and its work is counted with the frame that it is of.
        """
        glance = self._found(camera, probe)
        if glance is None:
            glance = pipeline.glance(camera, buffer.clouds, buffer.turn, probe)
        upcoming, self._upcoming = self._upcoming, None
        if upcoming is None:
            return pipeline.draw(camera, glance, buffer, probe)
        clouds = (glance.cloud, *buffer.clouds)[: pipeline.options.frames]
        with _half_of_the_threads() as others:
            ahead = self._thread.submit(
                _prospect, pipeline, upcoming, clouds, buffer.turn + 1, others
            )
            try:
                frame = pipeline.draw(camera, glance, buffer, probe)
            finally:
                with probe.stage("lookahead"):
                    wait([ahead])
        self._prospect = ahead.result()
        return frame

    def _found(self, camera: Camera, probe: Probe) -> Glance | None:
        """The glance at the frame of `camera`, if that was what was foreseen."""
        prospect, self._prospect = self._prospect, None
        if prospect is None or prospect.camera is not camera:
            return None
        prospect.work.tell(probe)
        return prospect.glance


class Ledger(NullProbe):
    """Work that is counted where no frame is measured, to be told of later."""

    def __init__(self) -> None:
        self._counts: list[tuple[str, int, int | None]] = []

    def count(self, name: str, done: int, dense: int | None = None) -> None:
        """See `bench.types.Probe`."""
        self._counts.append((name, done, dense))

    def tell(self, probe: Probe) -> None:
        """Count all of it there."""
        for count in self._counts:
            probe.count(*count)


def _prospect(
    pipeline: Pipeline, camera: Camera, clouds: Sequence[Cloud], turn: int, threads: int
) -> Prospect:
    torch.set_num_threads(threads)  # of this thread
    work = Ledger()
    return Prospect(camera, pipeline.glance(camera, clouds, turn, work), work)


@contextmanager
def _half_of_the_threads() -> Iterator[int]:
    """Leave as many threads as are yielded to another thread, but keep one."""
    threads = torch.get_num_threads()
    others = max(threads // 2, 1)
    torch.set_num_threads(max(threads - others, 1))
    try:
        yield others
    finally:
        torch.set_num_threads(threads)
