"""What a viewer draws, and for whom."""

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch

from bench.cameras import look_at
from bench.types import Camera, Frame
from bench.viewing import COARSE, FLUENT_MS, Ask, Painter, Turns, difference, divided, seen_from

CAMERA = Camera(torch.eye(3, 4), 40.0, 40.0, 16.0, 12.0, 32, 24)


class Counting:
    """Paints how many frames of a sequence there were, in 256ths."""

    name, frames = "counting", 0

    def reset(self):
        self.frames = 0

    def render(self, camera, probe):
        self.frames += 1
        with probe.stage("count"):
            rgb = torch.full((camera.height, camera.width, 3), self.frames / 255)
        return Frame(rgb, rgb[..., 0], rgb[..., 0])

    def settings(self):
        return {"device": "cpu"}


def test_only_the_newest_camera_of_a_browser_is_drawn_and_a_still_picture_gives_way():
    turns = Turns()
    older, newer = Ask(CAMERA), Ask(replace(CAMERA, fx=50.0))
    turns.want("a", older)
    turns.want("b", older)
    turns.want("a", newer)
    assert turns.next(0) == ("a", newer)  # who has waited longest
    assert turns.next(0) == ("b", older)
    assert turns.next(0) is None
    moving, still = Ask(CAMERA), Ask(CAMERA, still=True)
    turns.want("a", moving)
    turns.offer("a", still)
    assert turns.next(0) == ("a", moving)
    turns.offer("a", still)
    assert turns.next(0) == ("a", still)
    turns.want("a", moving)
    turns.forget("a")  # it has gone
    turns.forget("nobody")
    assert turns.next(0) is None


def test_who_waits_for_an_ask_wakes_up(monkeypatch):
    turns, woken = Turns(), []
    wait = turns._changed.wait

    def wait_and_ask(timeout=None):
        threading.Thread(target=turns.want, args=("a", Ask(CAMERA))).start()
        woken.append(wait(timeout))

    monkeypatch.setattr(turns._changed, "wait", wait_and_ask)
    assert turns.next(60) == ("a", Ask(CAMERA))
    assert woken == [True]  # not by the end of its time


def test_frames_are_timed_and_forgotten_for_another_browser_and_another_size():
    painter = Painter([Counting()])
    small = replace(CAMERA, width=16)
    asked = [("a", CAMERA), ("a", CAMERA), ("b", CAMERA), ("a", CAMERA), ("a", small)]
    shown = [painter.draw(who, camera)[0].rgb[0, 0, 0].item() for who, camera in asked]
    assert [round(255 * value) for value in shown] == [1, 2, 1, 1, 1]
    painter.draw("a", small)
    painter.put(0, painter.methods[0])
    (drawn,) = painter.draw("a", small)
    assert round(255 * drawn.rgb[0, 0, 0].item()) == 1
    assert set(drawn.stages_ms) == {"count", "other"}
    assert drawn.ms == pytest.approx(sum(drawn.stages_ms.values()), rel=1e-12)


def test_only_a_slow_method_draws_coarsely_and_only_while_the_camera_moves():
    painter = Painter([Counting()])
    painter._full_ms[CAMERA.width * CAMERA.height] = FLUENT_MS
    assert painter.sized(Ask(CAMERA)) is CAMERA
    painter._full_ms[CAMERA.width * CAMERA.height] = 2 * FLUENT_MS
    coarse = painter.sized(Ask(CAMERA))
    assert (coarse.width, coarse.height) == (32 // COARSE, 24 // COARSE)
    assert coarse.fx == CAMERA.fx / COARSE
    assert painter.sized(Ask(CAMERA, still=True)) is CAMERA


def test_a_divided_picture_has_one_method_on_either_side_and_a_difference_shows_both():
    left, right = torch.zeros(4, 10, 3), torch.full((4, 10, 3), 0.1)
    both = divided(left, right, 0.3)
    assert (both[:, :2] == 0).all()
    assert (both[:, 4:] == 0.1).all()
    assert torch.equal(divided(left, right, 0.0)[:, 1:], right[:, 1:])
    shown = difference(left, both)
    torch.testing.assert_close(shown[:, 4:], torch.full((4, 6, 3), 0.4))
    assert (shown[:, :2] == 0).all()


def test_the_camera_of_a_browser_is_the_pinhole_camera_of_its_pose():
    pose = look_at(*(torch.tensor(x) for x in ([0.5, -1.0, 0.5], [0.5] * 3, [0.0, 0.0, 1.0])))
    rotation, position = pose[:, :3].numpy(), pose[:, 3].numpy()
    camera = seen_from(rotation, position, fov=np.pi / 2, width=40, height=20)
    assert torch.equal(camera.c2w, pose)
    assert abs(camera.fy - 10) < 1e-9  # 90 degrees: as far away as half of the rows
    assert (camera.cx, camera.cy, camera.fx) == (20, 10, camera.fy)
    assert (camera.width, camera.height) == (40, 20)
