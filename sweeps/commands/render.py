"""`steerbench render`: renders every frame of a trajectory, as pictures and as a video."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, explained
from bench.metrics import as_bytes, quantise
from bench.protocol import check_frame
from bench.results import Store
from bench.trajectories import MIXED, write_path
from bench.types import Camera, Method, NullProbe
from bench.video import recorded
from sweeps.configured import build, scene_of, trained
from sweeps.overrides import beside, composed, setting


def main(options: argparse.Namespace) -> int:
    """Render; write `0000.png` and so on, the path and the video; print where they are."""
    words = [*words_of_run(options.run, options.overrides), *options.overrides]
    if options.path:
        words = [word for word in words if not re.match(r"[+~]*(trajectory\b|split=)", word)]
        place = setting("trajectory.path", str(options.path.resolve()))
        words = [*words, "trajectory=path", place]
    config = composed(words)
    log, scene = ConsoleLog(Path(config.outputs)), scene_of(config)
    trajectory = build(config, "trajectory", scene)
    if options.video and trajectory.resolution == MIXED:
        raise SteerbenchError("--video: expected frames of one size, the trajectory has several")
    others = [composed(beside(name, words)) for name in options.beside]
    methods = [trained(each, log) for each in (config, *others)]
    cameras = [step.camera for step in trajectory.steps]
    drawn = "-".join([scene.name, *(method.name for method in methods), trajectory.name])
    folder = options.output or Path(config.outputs) / "render" / drawn
    with explained(folder), ExitStack() as stack:
        folder.mkdir(parents=True, exist_ok=True)
        if not options.output:  # what an earlier call left there, of a longer path, say
            for old in folder.glob("[0-9]*.png"):
                old.unlink()
        if trajectory.resolution != MIXED:
            write_path(folder / "path.json", cameras, scene, options.fps)
        film = stack.enter_context(recorded(options.video, options.fps)) if options.video else None
        progress = stack.enter_context(log.progress("rendering", len(cameras)))
        for method in methods:
            method.reset()
        for index, camera in enumerate(cameras):
            picture = np.concatenate([_drawn(one, camera, index) for one in methods], axis=1)
            Image.fromarray(picture).save(folder / f"{index:04}.png")
            if film:
                film(picture)
            progress.advance()
    log.info(f"{len(cameras)} pictures: {folder}")
    if options.video:
        log.info(f"video: {options.video}")
    return 0


@torch.no_grad()
def _drawn(method: Method, camera: Camera, index: int) -> np.ndarray:
    """Render the next frame of `method` as uint8 [H, W, 3]."""
    frame = method.render(camera, NullProbe())
    check_frame(frame, camera, method.name, index)
    return as_bytes(quantise(frame.rgb.cpu()))


def words_of_run(key: str | None, words: Sequence[str]) -> list[str]:
    """The words of the command that measured the run `key` of the store."""
    if key is None:
        return []
    store = Store(Path(composed(words).outputs))
    _, command, *rest = shlex.split(str(store.record(store.whole_key(key))["command"]))
    if command != "run":
        raise SteerbenchError(f"run {key}: expected one of a method, got pictures that were scored")
    return [word for word in rest if not word.startswith("hydra.")]
