"""`steerbench generic`: train the 2D renderer that every scene starts from."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.console import ConsoleLog
from sweeps.build import build
from sweeps.measurement import checked_settings
from sweeps.overrides import composed

SETTINGS = (
    "method=steernerf",
    "scene=medley",
    "budget=generic",
    "method.pipeline.channels=3",  # features beyond colour mean something else in every scene
    "method.renderer.init=scratch",
)


def main(options: argparse.Namespace) -> int:
    """Fit a field to each of many random scenes, train one renderer on all, write its weights."""
    config = composed([*SETTINGS, *options.overrides])
    log = ConsoleLog(Path(checked_settings(config).outputs))
    method, budget = build(config, "method"), build(config, "budget")
    scenes = []
    for config.scene.variant in range(options.scenes):
        scenes.append(build(config, "scene", log=log))
    method.fit_generic(scenes, budget, options.output, log)
    return 0
