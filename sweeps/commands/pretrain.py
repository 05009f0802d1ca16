"""`steerbench pretrain`: trains the initial weights of the 2D renderer for all scenes."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from bench.threads import torch_threads
from sweeps.configured import build, checked_settings
from sweeps.overrides import composed

SETTINGS = (
    "method=steernerf_lean",
    "scene=medley",
    "budget=pretrain",
    "method.model.channels=3",  # features beyond colour have another meaning in every scene
    "method.renderer.init=scratch",
)


def main(options: argparse.Namespace) -> int:
    """Fit a field to each of many random scenes, train one renderer on all of them, write it."""
    config = composed([*SETTINGS, *options.overrides])
    if "variant" not in config.scene:
        raise SteerbenchError("scene: expected one that differs in each variant, such as medley")
    log = ConsoleLog(Path(checked_settings(config).outputs))
    method, budget = build(config, "method"), build(config, "budget")
    if not hasattr(method, "pretrain_renderer"):
        raise SteerbenchError(f"method: {method.name} has no 2D renderer that could be pretrained")
    scenes = []
    for config.scene.variant in range(options.scenes):
        scenes.append(build(config, "scene", log=log))
    with torch_threads(budget.threads):
        method.pretrain_renderer(scenes, budget, options.output, log)
    return 0
