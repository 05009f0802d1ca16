"""`steerbench view`: shows methods in a browser, with a camera steered by mouse."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from itertools import chain
from pathlib import Path

from bench.console import ConsoleLog
from bench.study import study_of
from bench.viewing import Painter
from sweeps.build import build
from sweeps.commands.render import words_of_run
from sweeps.configured import scene_of, trained
from sweeps.overrides import beside, composed
from sweeps.viewer import Viewer


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
    wanted = [words, *([beside(options.beside, words)] if options.beside else [])]
    configs = [composed(each) for each in wanted]
    log, scene = ConsoleLog(Path(configs[0].outputs)), scene_of(configs[0])
    first = build(configs[0], "trajectory", scene).steps[0].camera
    painter = Painter([trained(each, log) for each in configs])
    knobs = [
        {
            knob: {variant.name: variant.settings for variant in variants}
            for knob, variants in study_of(method).knobs.items()
        }
        for method in painter.methods
    ]
    turned: list[dict[str, Sequence[str]]] = [{} for _ in wanted]

    def turn(place: int, knob: str, setting: str) -> None:
        now = {**turned[place], knob: knobs[place][knob].get(setting, ())}  # none: as given
        painter.put(place, trained(composed([*wanted[place], *chain(*now.values())]), log))
        turned[place] = now

    address, folder = (options.host, options.port), Path(configs[0].outputs) / "view"
    viewer = Viewer(painter, scene, first, knobs, turn, folder, log, address)
    log.info(f"open http://{options.host}:{viewer.port} in a browser; Ctrl-C ends it")
    return viewer
