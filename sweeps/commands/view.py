"""`steerbench view`: shows methods in a browser, with a camera steered by mouse."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from bench.console import ConsoleLog
from bench.study import Variant, study_of
from bench.viewing import Painter
from sweeps.build import build
from sweeps.commands.render import words_of_run
from sweeps.configured import scene_of, trained
from sweeps.overrides import beside, composed
from sweeps.viewer import AS_GIVEN, Viewer


def main(options: argparse.Namespace) -> int:
    """Train or load the methods, serve the page, render until interrupted."""
    viewer = opened(options)
    try:
        while True:
            viewer.draw()
    finally:
        viewer.stop()


def opened(options: argparse.Namespace) -> Viewer:
    """Open the viewer that the command describes, and print its address.

    Raises:
        SteerbenchError: a setting is wrong, the training failed, or viser is not installed.
    """
    words = [*words_of_run(options.run, options.overrides), *options.overrides]
    others = [beside(options.beside, words)] if options.beside else []
    wanted = [_Tuned(each) for each in (words, *others)]
    config = composed(words)
    log, scene = ConsoleLog(Path(config.outputs)), scene_of(config)
    first = build(config, "trajectory", scene).steps[0].camera
    configs = [config, *(composed(one.words()) for one in wanted[1:])]
    painter = Painter([trained(each, log) for each in configs])
    for method, one in zip(painter.methods, wanted, strict=True):
        one.knobs = dict(study_of(method).knobs)
    names = [{name: [v.name for v in one.knobs[name]] for name in one.knobs} for one in wanted]

    def turn(place: int, knob: str, setting: str) -> None:
        one = wanted[place]
        before = dict(one.chosen)
        one.chosen[knob] = setting
        try:
            painter.put(place, trained(composed(one.words()), log))
        except Exception:
            one.chosen = before
            raise

    address, folder = (options.host, options.port), Path(config.outputs) / "view"
    viewer = Viewer(painter, scene, first, names, turn, folder, log, address)
    log.info(f"open http://{options.host}:{viewer.port} in a browser; Ctrl-C ends it")
    return viewer


class _Tuned:
    """The words that describe a method, and the current settings of its knobs."""

    def __init__(self, words: Sequence[str]) -> None:
        self._words = words
        self.knobs: dict[str, Sequence[Variant]] = {}
        self.chosen: dict[str, str] = {}

    def words(self) -> list[str]:
        """The words of the method with its knobs as currently set."""
        words = [*self._words]
        for knob, setting in self.chosen.items():
            if setting != AS_GIVEN:
                (variant,) = [v for v in self.knobs[knob] if v.name == setting]
                words += variant.settings
        return words
