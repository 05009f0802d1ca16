"""The field of the next frame beside the rest of this one, where the next camera is known."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch

from bench.threads import torch_threads
from bench.types import Camera, Frame, NullProbe, Probe
from methods.steernerf.buffer import Cloud, RenderingBuffer
from methods.steernerf.pipeline import Glance, Pipeline


@dataclass(frozen=True)
class Prospect:
    """What is computed ahead of a frame that nobody has asked for yet.

    Attributes:
        camera: of the frame.
        glance: at it, once it has ended.
        work: that it takes.
    """

    camera: Camera
    glance: Future[Glance]
    work: Ledger


class Lookahead:
    """Renders the frames of a sequence, of each its glance beside the rest of the one before it.

    While both are at work each has half of torch's threads, of which there must be two. A stage
    seldom takes half the time on twice as many, for they wait for each other at the end of each of
    its loops; so two frames at a time take less than two frames one after the other. Which of them
    is left when the other has ended has all threads from its next stage on. The threads of another
    engine's network are its own: it keeps them all.
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

        The glance has ended when this returns. The time that it is waited for is the stage
        `lookahead`; its work, and what may go wrong in it, is that of the frame that it is of.
        """
        glance = self._found(camera, probe)
        if glance is None:
            glance = pipeline.glance(camera, buffer.clouds, buffer.turn, probe)
        upcoming, self._upcoming = self._upcoming, None
        if upcoming is None:
            return pipeline.draw(camera, glance, buffer, probe)
        clouds = (glance.cloud, *buffer.clouds)[: pipeline.options.frames]
        work, drawn = Ledger(), threading.Event()
        threads = torch.get_num_threads()
        others = threads // 2
        with torch_threads(threads - others):
            beside = _Beside(work, drawn.is_set, threads)
            arguments = pipeline, upcoming, clouds, buffer.turn + 1, beside, others, drawn.is_set
            ahead = self._thread.submit(_glance, *arguments)
            try:
                frame = pipeline.draw(camera, glance, buffer, _Beside(probe, ahead.done, threads))
            finally:
                drawn.set()
                with probe.stage("lookahead"):
                    wait([ahead])
        self._prospect = Prospect(upcoming, ahead, work)
        return frame

    def _found(self, camera: Camera, probe: Probe) -> Glance | None:
        """The glance at the frame of `camera`, if that was what was foreseen."""
        prospect, self._prospect = self._prospect, None
        if prospect is None or prospect.camera is not camera:
            return None
        prospect.work.tell(probe)
        return prospect.glance.result()


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


class _Beside:
    """A probe that has all `threads` of torch serve the calling thread from the first stage on that
    it enters `alone`."""

    def __init__(self, probe: Probe, alone: Callable[[], bool], threads: int) -> None:
        self._probe, self._alone, self._threads = probe, alone, threads
        self.count = probe.count

    def stage(self, name: str) -> AbstractContextManager[None]:
        """See `bench.types.Probe`."""
        if self._alone() and torch.get_num_threads() != self._threads:
            torch.set_num_threads(self._threads)
        return self._probe.stage(name)


@torch.no_grad()
def _glance(
    pipeline: Pipeline,
    camera: Camera,
    clouds: Sequence[Cloud],
    turn: int,
    probe: Probe,
    threads: int,
    enough: Callable[[], bool],
) -> Glance:
    """A glance, and as much of the surface in it as there is time for."""
    torch.set_num_threads(threads)  # of this thread
    glance = pipeline.glance(camera, clouds, turn, probe)
    if glance.sight.surface:
        glance.sight.surface.look(probe, enough)
    return glance
