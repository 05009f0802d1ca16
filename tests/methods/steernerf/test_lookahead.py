"""A glance at the next frame beside this one: the same pictures and work, at the same time."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import pytest
import torch
from tests.methods.test_pipeline import OPTIONS, new_pipeline
from tests.methods.test_refresh import EVERYWHERE
from torch import Tensor

from bench.probes import StageClock
from bench.threads import torch_threads
from bench.types import Camera, NullProbe
from methods.steernerf.buffer import RenderingBuffer
from methods.steernerf.lookahead import Lookahead
from methods.steernerf.options import PipelineOptions
from methods.steernerf.pipeline import Glance, Pipeline
from methods.steernerf.range_reduction import RangeReduction
from methods.steernerf.refresh import Refresh
from tests.methods.conftest import Work, look_at_the_middle
from tests.methods.solids import Solid, ball

PATH = [look_at_the_middle(0.1 + 0.004 * i, 0.3) for i in range(4)]
PATH += [look_at_the_middle(0.6, -0.3), *PATH[:2]]  # there, and back at once
PATIENCE = 60.0
"""Seconds after which one that waits for another gives up."""


def rendered(
    pipeline: Pipeline, path: Sequence[Camera], upcoming: Sequence[Camera | None]
) -> tuple[list[Tensor], Work]:
    """The pictures of `path`, told before each of those in `upcoming`, and all the work."""
    lookahead, buffer, work = Lookahead(), RenderingBuffer(pipeline.options.frames), Work()
    pictures = []
    for camera, following in zip(path, upcoming, strict=True):
        if following is not None:
            lookahead.foresee(following)
        pictures.append(lookahead.render(pipeline, camera, buffer, work).rgb)
    return pictures, work


@pytest.mark.parametrize(
    "options",
    [
        OPTIONS,
        replace(OPTIONS, frames=0),
        replace(OPTIONS, jitter=True, overlap=0.5, refined=0.2),
        replace(OPTIONS, range=RangeReduction("window")),
    ],
)
def test_what_is_foreseen_has_the_same_pictures_and_takes_the_same_work(
    options: PipelineOptions,
) -> None:
    pipeline = new_pipeline(options)
    buffer, alone = RenderingBuffer(options.frames), Work()
    want = [pipeline.render(camera, buffer, alone).rgb for camera in PATH]
    got, work = rendered(pipeline, PATH, [*PATH[1:], None])
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
    assert work.done == alone.done


def test_what_is_taken_over_is_as_old_as_without() -> None:
    """The ages are of the frame that is glanced at, and needed for the one after it."""
    options = replace(OPTIONS, steps=1, refresh=Refresh(age=2, tolerance=1.0))
    pipeline = new_pipeline(options)
    pipeline.field, pipeline.occupancy = Solid(ball()), EVERYWHERE
    path = [replace(camera, width=128, height=128, cx=64, cy=64, fx=240) for camera in PATH[:4]]
    path = [replace(camera, fy=240) for camera in path]
    want, alone = rendered(pipeline, path, [None] * len(path))
    got, work = rendered(pipeline, path, [*path[1:], None])
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
    assert work.done == alone.done
    assert work.done["known_pixels"] > 100


def test_what_was_foreseen_and_does_not_come_does_not_matter() -> None:
    pipeline = new_pipeline()
    want, _ = rendered(pipeline, PATH, [None] * len(PATH))
    got, _ = rendered(pipeline, PATH, PATH)  # each frame stands still, they said
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_a_new_sequence_knows_nothing_of_the_last_one() -> None:
    pipeline, lookahead, buffer = new_pipeline(), Lookahead(), RenderingBuffer(2)
    first = lookahead.render(pipeline, PATH[1], buffer, NullProbe()).rgb
    lookahead.foresee(PATH[1])
    lookahead.render(pipeline, PATH[0], buffer, NullProbe())
    lookahead.foresee(PATH[2])
    buffer.reset()
    lookahead.forget()
    assert torch.equal(lookahead.render(pipeline, PATH[1], buffer, NullProbe()).rgb, first)
    assert lookahead._prospect is None


class Watched(Pipeline):
    """Runs `in_glance` and `in_draw` before a glance, but the first one, and before a drawing; and
    tells on how many of torch's threads they ended, and what the last glance was."""

    in_glance = in_draw = staticmethod(lambda: None)
    glances = 0
    ended: dict[str, int]
    last: Glance

    def glance(self, *arguments: Any) -> Any:
        self.glances += 1
        if self.glances > 1:
            self.in_glance()
        result = super().glance(*arguments)
        self.ended["glance"], self.last = torch.get_num_threads(), result
        return result

    def draw(self, *arguments: Any) -> Any:
        self.in_draw()
        result = super().draw(*arguments)
        self.ended["draw"] = torch.get_num_threads()
        return result


@pytest.fixture
def watched() -> Watched:
    pipeline = new_pipeline()
    pipeline.__class__ = Watched
    assert isinstance(pipeline, Watched)
    pipeline.ended = {}
    return pipeline


def test_the_next_frame_is_glanced_at_while_this_one_is_drawn(watched: Watched) -> None:
    meeting = threading.Barrier(2)
    watched.in_glance = watched.in_draw = lambda: meeting.wait(PATIENCE)
    lookahead = Lookahead()
    lookahead.foresee(PATH[1])
    lookahead.render(watched, PATH[0], RenderingBuffer(2), NullProbe())
    assert watched.glances == 2


@pytest.mark.parametrize(("threads", "halves"), [(2, (1, 1)), (3, (2, 1))])
def test_both_have_half_of_the_threads_and_later_all_are_back(
    watched: Watched, threads: int, halves: tuple[int, int]
) -> None:
    seen: dict[str, int] = {}
    watched.in_draw = lambda: seen.update(draw=torch.get_num_threads())
    watched.in_glance = lambda: seen.update(glance=torch.get_num_threads())
    lookahead, before = Lookahead(), torch.get_num_threads()
    lookahead.foresee(PATH[1])
    try:
        torch.set_num_threads(threads)
        lookahead.render(watched, PATH[0], RenderingBuffer(2), NullProbe())
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert (seen["draw"], seen["glance"]) == halves


@pytest.fixture
def two_threads() -> Iterator[None]:
    with torch_threads(2):
        yield


def test_a_drawing_that_is_left_has_all_threads(watched: Watched, two_threads: None) -> None:
    lookahead = Lookahead()
    # The thread does one thing after the other: when it has done this, the glance has ended.
    watched.in_draw = lambda: lookahead._thread.submit(int).result(PATIENCE)
    lookahead.foresee(PATH[1])
    lookahead.render(watched, PATH[0], RenderingBuffer(2), NullProbe())
    assert watched.ended == {"draw": 2, "glance": 1}
    assert watched.last.sight.surface
    assert len(watched.last.sight.surface._found) == 1  # there was time for its only piece


def test_a_glance_that_is_left_has_all_threads(watched: Watched, two_threads: None) -> None:
    waited_for = threading.Event()

    class Telling(NullProbe):
        def stage(self, name: str) -> AbstractContextManager[None]:
            if name == "lookahead":
                waited_for.set()
            return super().stage(name)

    watched.in_glance = lambda: waited_for.wait(PATIENCE)
    lookahead = Lookahead()
    lookahead.foresee(PATH[1])
    lookahead.render(watched, PATH[0], RenderingBuffer(2), Telling())
    assert watched.glances == 2
    assert watched.ended == {"draw": 1, "glance": 2}
    assert watched.last.sight.surface
    assert watched.last.sight.surface._found == []  # that is left to the next drawing


def fail() -> None:
    raise ArithmeticError


def test_when_a_drawing_fails_its_frame_does_and_the_glance_has_ended(watched: Watched) -> None:
    watched.in_draw = fail
    lookahead, buffer, threads = Lookahead(), RenderingBuffer(2), torch.get_num_threads()
    lookahead.foresee(PATH[1])
    with pytest.raises(ArithmeticError):
        lookahead.render(watched, PATH[0], buffer, NullProbe())
    assert watched.glances == 2
    assert torch.get_num_threads() == threads
    assert buffer.frames == ()


def test_when_a_glance_fails_the_frame_that_it_is_of_does(watched: Watched) -> None:
    watched.in_glance = fail
    lookahead, buffer, threads = Lookahead(), RenderingBuffer(2), torch.get_num_threads()
    lookahead.foresee(PATH[1])
    lookahead.render(watched, PATH[0], buffer, NullProbe())
    assert torch.get_num_threads() == threads
    with pytest.raises(ArithmeticError):
        lookahead.render(watched, PATH[1], buffer, NullProbe())
    assert buffer.turn == 1


def test_the_wait_for_the_glance_is_a_stage_and_there_is_none_without() -> None:
    pipeline, lookahead, buffer = new_pipeline(), Lookahead(), RenderingBuffer(2)
    clock = StageClock("cpu")
    for camera, following in ((PATH[0], PATH[1]), (PATH[1], None)):
        if following is not None:
            lookahead.foresee(following)
        with clock.frame():
            lookahead.render(pipeline, camera, buffer, clock)
    told, foreseen = (frame.stages_ns for frame in clock.frames)
    assert "lookahead" in told
    assert not {"lookahead", "field", "depth_reprojection"} & set(foreseen)
