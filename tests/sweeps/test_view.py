"""`steerbench view`, by a stand-in for a browser that speaks viser's protocol."""

import io
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from sweeps import cli
from sweeps.commands import view
from sweeps.commands.view import AS_GIVEN, Viewer
from tests.common import read_json

from .conftest import STAND_INS
from .test_external import documented  # noqa: F401 (a fixture)

msgspec = pytest.importorskip("msgspec")
viser = pytest.importorskip("viser")
zstandard = pytest.importorskip("zstandard")
client = pytest.importorskip("websockets.sync.client")
ConnectionClosed = pytest.importorskip("websockets.exceptions").ConnectionClosed

TICK_S, ROUNDS = 0.02, 2000
"""How long is waited for a message at a time, and how often: for what takes no time, unless
something is broken."""


class Page:
    """A browser that has the page open: cameras go there, pictures and controls come back."""

    def __init__(self, viewer, socket):
        self._viewer, self._socket = viewer, socket
        self._controls: dict[str, dict[str, Any]] = {}
        self.picture = np.zeros((0, 0, 3), int)
        """The last one, [H, W, 3] from 0 to 255."""

    def look(self, x=0.5):
        pose = {"wxyz": (1.0, 0.0, 0.0, 0.0), "position": (x, 0.5, -1.0), "fov": np.pi / 3}
        far = {"near": 0.01, "far": 1000.0, "look_at": (x, 0.5, 0.5)}
        size = {"image_height": 300, "image_width": 600, "up_direction": (0.0, -1.0, 0.0)}
        self._send("ViewerCameraMessage", **pose, **far, **size)

    def see(self):
        """Look, and wait for a picture."""
        self.look()
        self.until(lambda: self.picture.size > 0)

    def choose(self, label, value):
        self.until(lambda: label in self._controls)
        uuid = self._controls[label]["uuid"]
        self._send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    def close(self):
        self._socket.close()

    def until(self, holds):
        """Let the viewer draw and receive what it sends until something holds."""
        for _ in range(ROUNDS):
            if holds():
                return
            self._viewer.draw(TICK_S)
            with suppress(TimeoutError, ConnectionClosed):
                self._receive(self._socket.recv(timeout=TICK_S))
        pytest.fail("it did not come to hold")

    def _send(self, kind, **fields):
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def _receive(self, data):
        size = int.from_bytes(data[8:16], "little")
        inner = zstandard.ZstdDecompressor().decompress(data[16 : 16 + size])
        for message in msgspec.msgpack.decode(inner)["messages"]:
            if "label" in (message.get("props") or {}):
                self._controls[message["props"]["label"]] = message
            if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
                shown = Image.open(io.BytesIO(message["rgb_data"]))
                self.picture = np.asarray(shown).astype(int)


@contextmanager
def browser(viewer: Viewer) -> Iterator[Page]:
    protocol = f"viser-v{viser.__version__}"
    address = f"ws://127.0.0.1:{viewer.server.get_port()}"
    with client.connect(address, subprotocols=[protocol], max_size=None) as socket:
        yield Page(viewer, socket)


@pytest.fixture
def opened(steerbench, tmp_path) -> Iterator[Callable[..., Viewer]]:
    viewers = []

    def open_(*words):
        options = cli.parsed(["view", "--port", "18080", *STAND_INS, *words])
        viewers.append(view.opened(options))
        return viewers[-1]

    yield open_
    for viewer in viewers:
        viewer.stop()


def test_a_turned_knob_is_another_method(opened):
    viewer = opened("method=shades")
    with browser(viewer) as page:
        page.see()
        before = page.picture.mean()
        assert before < 250
        page.choose("level", "level 1.0")
        page.until(lambda: page.picture.mean() > 250)
        page.choose("level", AS_GIVEN)
        page.until(lambda: page.picture.mean() == before)


def test_two_methods_stand_side_by_side(opened):
    viewer = opened("method.level=0.4", "--beside", "shades")
    with browser(viewer) as page:
        page.see()
        left, right = page.picture[:, 1].mean(), page.picture[:, -2].mean()
        assert abs(left - 102) < 3
        (seen,) = viewer.browsers.values()
        page.until(lambda: "left: **grey**" in seen.figures.content)
        assert "right: **shades**" in seen.figures.content
        page.choose("picture", "difference x 4")
        page.until(lambda: abs(page.picture.mean() - min(4 * abs(right - left), 255)) < 8)


def test_a_recorded_path_can_be_measured(opened, steerbench):
    viewer = opened()
    with browser(viewer) as page:
        page.look()
        page.choose("record a path", True)
        page.until(lambda: [len(b.path) for b in viewer.browsers.values()] == [1])
        (path,) = (b.path for b in viewer.browsers.values())
        for count, x in ((2, 0.4), (3, 0.6)):
            page.look(x)
            page.until(lambda count=count: len(path) == count)
        page.choose("record a path", False)
        page.until(lambda: not path)
    (file,) = Path("outputs/view").glob("*.json")
    assert len(read_json(file)["camera_path"]) == 3
    steerbench("run", *STAND_INS, "trajectory=path", f"trajectory.path={file}").ok()


def test_a_browser_that_leaves_in_the_middle_of_a_frame_takes_nothing_with_it(opened, monkeypatch):
    viewer, left = opened(), threading.Event()
    viewer.server.on_client_disconnect(lambda _: left.set())
    (method,) = viewer.painter.methods
    with browser(viewer) as page:
        whole = type(method).render

        def interrupted(self, *args):
            page.close()
            assert left.wait(TICK_S * ROUNDS)
            return whole(self, *args)

        with monkeypatch.context() as patch:
            patch.setattr(type(method), "render", interrupted)
            page.look()
            page.until(left.is_set)
    with browser(viewer) as other:
        other.look()
        other.until(lambda: other.picture.size > 0 and len(viewer.browsers) == 1)


def test_a_picture_that_fails_is_named_and_the_next_is_drawn(opened, capfd):
    viewer = opened()
    (method,) = viewer.painter.methods
    method.level = float("nan")
    with browser(viewer) as page:
        page.look()
        page.until(lambda: "as NaN or infinite" in capfd.readouterr().err)
        method.level = 0.5
        page.look(0.4)
        page.until(lambda: page.picture.size > 0)


def test_browsers_get_pictures_of_their_own_shapes(opened):
    viewer = opened("method.level=0.4")
    rows = viewer.first.height
    with browser(viewer) as one, browser(viewer) as two:
        one.look()
        two.look()
        two.choose("rows", 2 * rows)
        for page, height in ((one, rows), (two, 2 * rows)):
            page.until(lambda page=page, height=height: len(page.picture) == height)
            assert page.picture.shape == (height, 2 * height, 3)
            assert np.abs(page.picture - 102).max() <= 2  # JPEG


def test_it_serves_this_machine_alone_unless_told_otherwise():
    assert cli.parsed(["view"]).host == "127.0.0.1"
