"""`steerbench render`: renders every frame of a trajectory, as pictures and as a video."""

import argparse
import re
import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig
from PIL import Image

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, explained, optional
from bench.isolation import lent
from bench.kinds import Words
from bench.metrics import as_bytes, quantise
from bench.paths import write_path
from bench.results import existing_store
from bench.scoring import taken
from bench.trajectories import MIXED
from bench.types import BACKGROUNDS, Camera, Method, NullProbe, Scene
from sweeps.configured import build, scene_of, trained, trajectory_of
from sweeps.overrides import beside, composed, setting

QUALITY = "18"  # H.264's constant rate factor: the video hardly differs from the original


def main(options: argparse.Namespace) -> int:
    """Render; write `0000.png` and so on, the path and the video; print where they are."""
    words = words_of_run(options.run, options.overrides)
    if options.path:
        replaced = re.compile(r"[+~]*(trajectory(?!\.transforms=)\b|split=)")
        words = [word for word in words if not replaced.match(word)]
        place = setting("trajectory.path", str(options.path.resolve()))
        words = [*words, "trajectory=path", place]
    configs = [composed(of) for of in (words, *(beside(name, words) for name in options.beside))]
    config = configs[0]
    log = ConsoleLog(Path(config.outputs))
    scene = seen(options.path, words, configs) or scene_of(config)
    trajectory = trajectory_of(config, scene, log)
    if options.video:
        if trajectory.resolution == MIXED:
            raise SteerbenchError("--video: expected frames of one size, the path has several")
        library_of(options.video)  # before any training
    methods = [trained(each, log, scene) for each in configs]
    cameras = [step.camera for step in trajectory.steps]
    drawn = "-".join(filter(None, [scene.name, *(one.name for one in methods), trajectory.name]))
    folder = options.to or Path(config.outputs) / "render" / drawn
    with explained(folder), ExitStack() as stack:
        folder.mkdir(parents=True, exist_ok=True)
        if not options.to:  # what an earlier call left there, of a longer path, say
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


def seen(path: Path | None, words: Words, configs: Sequence[DictConfig]) -> Scene | None:
    """A scene without pictures, in the coordinates of files: for a `path` of its own and methods
    that are trained already, unless `words` name a scene, which may take minutes to make."""
    named = any(re.match(r"[+~]*scene(\.name)?=", word) for word in words)
    if not path or named or any(getattr(build(c, "method"), "trains", True) for c in configs):
        return None
    background = torch.full((3,), BACKGROUNDS[configs[0].scene.background])
    cube = torch.stack((torch.zeros(3), torch.ones(3)))
    return Scene("", {}, background, cube, unit_length=1.0, digest="")


@torch.no_grad()
def _drawn(method: Method, camera: Camera, index: int) -> np.ndarray:
    """Render the next frame of `method` as uint8 [H, W, 3]."""
    frame = taken(method.render(lent(camera), NullProbe()), camera, method.name, index)
    return as_bytes(quantise(frame.rgb.cpu()))


def library_of(video: Path) -> Any:
    """The library that writes a video; raises Unavailable if it is not installed."""
    otherwise = "; without --video the pictures alone are written"
    return optional("av", "video", f"{video}: a video", otherwise)


@contextmanager
def recorded(path: Path, fps: float) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that appends a picture, uint8 [H, W, 3], to a video; all have the same size.

    H.264 needs even sizes: if the height or width is odd, the last row or column is repeated.
    Raises Unavailable without PyAV, and SteerbenchError if the file cannot be written or its ending
    is not that of a video.
    """
    av = library_of(path)
    try:
        with av.open(path, "w") as container:
            stream = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1000))
            stream.pix_fmt, stream.options = "yuv420p", {"crf": QUALITY}

            def take(picture: np.ndarray) -> None:
                height, width = picture.shape[:2]
                even = np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
                if not stream.codec_context.is_open:
                    stream.height, stream.width = even.shape[:2]
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24")
                container.mux(stream.encode(frame))

            yield take
            container.mux(stream.encode())
    except (av.error.FFmpegError, ValueError) as error:
        raise SteerbenchError(f"{path}: cannot write the video: {error}") from error


def words_of_run(key: str | None, words: Words) -> list[str]:
    """The words of the command that measured the run `key` of the store, and `words` after them."""
    if key is None:
        return list(words)
    store = existing_store(Path(composed(words).outputs))
    _, command, *rest = shlex.split(str(store.record(store.whole_key(key))["command"]))
    if command != "run":
        raise SteerbenchError(f"run {key}: expected one of `steerbench run`, got {command}")
    return [*(word for word in rest if not word.startswith("hydra.")), *words]
