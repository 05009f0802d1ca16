"""`steerbench view`: shows methods in a browser, with a camera steered by mouse.

The page is built on viser; it also has the knobs of the methods, and their figures.
"""

from __future__ import annotations

import argparse
from collections.abc import Hashable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from functools import partial
from io import StringIO
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import pack_camera
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, optional
from bench.kinds import Words
from bench.metrics import as_bytes, psnr
from bench.paths import write_path
from bench.study import study_of
from bench.types import Camera, composite
from bench.viewing import Ask, Drawn, Painter, Turns, difference, divided, seen_from
from reports.lines import Settings
from sweeps.commands.render import words_of_run
from sweeps.configured import build, scene_of, trained
from sweeps.overrides import beside, composed

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer

AS_GIVEN = "as given"  # the setting of a knob that was not changed

SIDE, DIFFERENCE, ERROR, TRUTH = "side by side", "difference x 4", "error x 4", "exact picture"
EXACT = (ERROR, TRUTH)  # the views that need the exact picture


@dataclass
class Browser:
    """The state of one browser: its choices, and the cameras that it records."""

    client: ClientHandle
    shown: Any
    split: Any
    height: Any
    exact: Any
    record: Any
    figures: Any
    stages: Any
    path: list[Camera] = field(default_factory=list)
    camera: Camera | None = None
    drawn: list[Drawn] | None = None
    """The latest pictures of `camera`; None: out of date because the methods have changed."""


def main(options: argparse.Namespace) -> int:
    """Serve the page and render until interrupted."""
    viewer = opened(options)
    try:
        while True:
            viewer.draw()
    finally:
        viewer.stop()


def opened(options: argparse.Namespace) -> Viewer:
    """Open the viewer that the command describes, and print its address."""
    words = words_of_run(options.run, options.overrides)
    wanted = [words, *([beside(options.beside, words)] if options.beside else [])]
    viewer = Viewer(wanted, options.host, options.port)
    port = viewer.server.get_port()  # the next free one if the requested one is taken
    viewer.log.info(f"open http://{options.host}:{port} in a browser; Ctrl-C ends it")
    return viewer


class Viewer:
    """Serves the page and renders until it is stopped.

    `wanted` are the words of one method, as for `steerbench run`, or of two to compare; the first
    ones choose the scene, the first camera and the folder of outputs. Raises SteerbenchError if
    viser is not installed, or the address cannot be served.
    """

    def __init__(self, wanted: Sequence[Words], host: str, port: int) -> None:
        viser = optional("viser", "viewer", "view")  # before any training
        configs = [composed(words) for words in wanted]
        outputs = Path(configs[0].outputs)
        self.wanted, self.log, self.folder = wanted, ConsoleLog(outputs), outputs / "view"
        self.scene = scene_of(configs[0])
        self.first: Camera = build(configs[0], "trajectory", self.scene).steps[0].camera
        self.painter = Painter([trained(config, self.log) for config in configs])
        self.turns, self.browsers = Turns(), dict[Hashable, Browser]()
        self._asked: list[tuple[int, str, Words]] = []
        self._turned: list[Settings] = [{} for _ in wanted]
        self.server = _serve(viser, host, port)
        cameras = self.scene.splits["train"].cameras
        up = -torch.stack([camera.c2w[:, 1] for camera in cameras]).sum(dim=0)
        self.server.scene.set_up_direction(functional.normalize(up, dim=0).double().numpy())
        self._look(self.server.initial_camera, self.first)
        self._add_knobs()
        self.server.on_client_connect(self._join)
        self.server.on_client_disconnect(self._leave)

    def draw(self, timeout: float | None = None) -> bool:
        """Render for the browser that has waited longest; False if none waits for `timeout` s."""
        waiting = self.turns.next(timeout)
        while self._asked:
            self._turn(*self._asked.pop(0))
        if waiting is None:
            return False
        who, ask = waiting
        browser = self.browsers.get(who)
        if browser is not None:  # it is still connected
            try:
                self._draw(browser, ask)
            except SteerbenchError as error:
                self._refuse("no picture", error)
        return True

    def _draw(self, browser: Browser, ask: Ask) -> None:
        """Render what a browser requests, or reuse its last picture if the camera is the same."""
        who, camera = browser.client.client_id, self.painter.sized(ask)
        whole = camera is ask.camera
        if not (browser.drawn and browser.camera and _same(browser.camera, camera)):
            browser.drawn, browser.camera = self.painter.draw(who, camera), camera
        truth = None
        if self.scene.exact and whole and (browser.exact.value or browser.shown.value in EXACT):
            truth = composite(self.scene.exact(camera), self.scene.background)
        picture = self._picture(browser, browser.drawn, truth)
        if who in self.browsers:  # still connected
            scene = browser.client.scene
            scene.set_background_image(as_bytes(picture), "jpeg", jpeg_quality=90)
            sides = ("left: ", "right: ") if browser.shown.value == SIDE else ("", "")
            browser.figures.content = _figures(self.painter, browser.drawn, truth, sides)
            browser.stages.content = _stages(self.painter, browser.drawn)
        if not whole:
            self.turns.offer(who, Ask(ask.camera, still=True))
        elif browser.record.value:
            if not (browser.path and _same(browser.path[-1], camera)):
                browser.path.append(camera)
        elif browser.path:
            self._save(browser)

    def stop(self) -> None:
        with redirect_stdout(StringIO()):
            self.server.stop()

    def _look(self, at: Any, camera: Camera) -> None:
        """Point a camera of viser, of a browser or the initial one, like `camera`."""
        position, middle = camera.centre, self.scene.bounds.mean(dim=0)
        ahead = camera.c2w[:, 2]
        distance = torch.dot(middle - position, ahead).clamp(min=0.1)
        at.position, at.look_at = position.numpy(), (position + distance * ahead).numpy()
        at.fov = 2 * float(np.arctan(camera.height / 2 / camera.fy))

    def _add_knobs(self) -> None:
        gui = self.server.gui
        for place, method in enumerate(self.painter.methods):
            if not (knobs := study_of(method).knobs):
                continue
            last = 1e6  # below all without an order of their own
            with gui.add_folder(f"knobs of {method.name}", order=last, expand_by_default=False):
                for knob, variants in knobs.items():
                    settings = {AS_GIVEN: (), **{each.name: each.settings for each in variants}}
                    choice = gui.add_dropdown(knob, tuple(settings))
                    choice.on_update(partial(self._note, place, knob, settings))

    def _note(self, place: int, knob: str, settings: Settings, event: Any) -> None:
        self._asked.append((place, knob, settings[event.target.value]))
        for who in list(self.browsers):
            self._want(who)

    def _turn(self, place: int, knob: str, settings: Words) -> None:
        now = {**self._turned[place], knob: settings}
        try:
            words = [*self.wanted[place], *chain(*now.values())]
            config = composed([*words, "exclusive=false"])  # nothing is trained, as a rule
            self.painter.put(place, trained(config, self.log))
            self._turned[place] = now
        except SteerbenchError as error:
            self._refuse(knob, error)
        for browser in list(self.browsers.values()):
            browser.drawn = None

    def _refuse(self, what: str, error: SteerbenchError) -> None:
        self.log.info(f"{what}: {error}")
        for browser in list(self.browsers.values()):
            browser.client.add_notification(what, str(error), color="red")

    def _join(self, client: ClientHandle) -> None:
        gui, names = client.gui, [method.name for method in self.painter.methods]
        two = len(names) == 2
        choices = [*dict.fromkeys(names), *((SIDE, DIFFERENCE) if two else ())]
        choices += [TRUTH, ERROR] if self.scene.exact else []
        shown = gui.add_dropdown("picture", choices, initial_value=SIDE if two else choices[0])
        split = gui.add_slider("divided at", 0.0, 1.0, 0.01, 0.5, visible=two)
        figures = gui.add_markdown("drawing the first picture ...")
        with gui.add_folder("more", expand_by_default=False):  # a phone has no room for it
            browser = Browser(
                client,
                shown=shown,
                split=split,
                height=gui.add_slider("rows", 16, 2160, 8, self.first.height),
                exact=gui.add_checkbox("PSNR", False, visible=self.scene.exact is not None),
                record=gui.add_checkbox("record a path", False),
                figures=figures,
                stages=gui.add_markdown(""),
            )
            first = gui.add_button("first view")
        for control in (shown, split, browser.height, browser.exact, browser.record):
            control.on_update(lambda _: self._want(client.client_id))
        first.on_click(lambda _: self._look(client.camera, self.first))
        self.browsers[client.client_id] = browser
        client.camera.on_update(lambda _: self._want(client.client_id))
        self._want(client.client_id)

    def _leave(self, client: ClientHandle) -> None:
        self.turns.forget(client.client_id)
        self.browsers.pop(client.client_id, None)

    def _want(self, who: Hashable) -> None:
        if browser := self.browsers.get(who):
            self.turns.want(who, Ask(_camera(browser.client.camera, int(browser.height.value))))

    def _save(self, browser: Browser) -> None:
        last = browser.path[-1]
        cameras = [c for c in browser.path if c.size == last.size]
        self.folder.mkdir(parents=True, exist_ok=True)
        numbered = (self.folder / f"path-{number}.json" for number in count(1))
        file = next(path for path in numbered if not path.exists())
        write_path(file, cameras, self.scene)
        note = f"{len(cameras)} views: trajectory=path trajectory.path={file}"
        self.log.info(note)
        browser.client.add_notification("path saved", note)
        browser.path.clear()

    def _picture(self, browser: Browser, drawn: Sequence[Drawn], truth: Tensor | None) -> Tensor:
        shown, first, last = browser.shown.value, drawn[0].rgb, drawn[-1].rgb
        if shown == SIDE:
            return divided(first, last, browser.split.value)
        if shown == DIFFERENCE:
            return difference(first, last)
        if shown in EXACT and truth is not None:
            return truth if shown == TRUTH else difference(first, truth)
        names = [method.name for method in self.painter.methods]
        return drawn[names.index(shown)].rgb if shown in names else first


def _serve(viser: Any, host: str, port: int) -> ViserServer:
    try:
        with redirect_stdout(StringIO()):  # viser would print its address in a box
            server = viser.ViserServer(host=host, port=port, label="steerbench", verbose=False)
    except OSError as error:
        raise SteerbenchError(f"cannot serve {host}:{port}: {error}") from error
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def _camera(handle: CameraHandle, height: int) -> Camera:
    """The camera of a browser, with `height` rows and square pixels."""
    import viser.transforms

    rotation = viser.transforms.SO3(handle.wxyz).as_matrix()
    width = max(round(height * handle.aspect), 1)
    return seen_from(rotation, handle.position, handle.fov, width, height)


def _same(one: Camera, other: Camera) -> bool:
    return torch.equal(pack_camera(one), pack_camera(other))


def _figures(
    painter: Painter, drawn: Sequence[Drawn], truth: Tensor | None, sides: Sequence[str]
) -> str:
    lines = []
    for side, method, picture in zip(sides, painter.methods, drawn, strict=False):
        quality = "" if truth is None else f", {psnr(picture.rgb, truth):.2f} dB"
        lines.append(f"{side}**{method.name}** {picture.ms:.0f} ms{quality}")
    return "\n\n".join(lines)


def _stages(painter: Painter, drawn: Sequence[Drawn]) -> str:
    height, width = drawn[0].rgb.shape[:2]
    lines = [f"{width} x {height} pixels", ""]
    for method, picture in zip(painter.methods, drawn, strict=True):
        lines += [f"| {method.name} | ms |", "|---|---|"]
        lines += [f"| {stage} | {ms:.1f} |" for stage, ms in picture.stages_ms.items()]
        lines.append("")
    return "\n".join(lines)
