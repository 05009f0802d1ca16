"""Writes a scene with a path and its true pictures, for other programs to train on and to render.

The pictures to learn from are those of the training split, the frames of the path the test split.

- `blender`: NeRF-Synthetic's, `transforms_{train,test}.json` beside RGBA pictures.
- `colmap`: `images` and `sparse/0`, only of the training pictures: programs that hold out every
  eighth picture themselves would train on the others of a path. The path is a capture of its own,
  in `test`. The points are random ones in the scene's bounds.
- `nerfbaselines`: as `blender`, with `nb-info.json`, and the path as `path.json`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.cameras import move_camera
from bench.errors import explained, unexpected
from bench.metrics import as_bytes
from bench.scenes.blender import camera_file
from bench.scenes.files import opengl_to_opencv
from bench.threads import in_parallel
from bench.trajectories import Trajectory, write_path
from bench.types import Camera, Log, Scene, composite

POINTS = 10_000  # random ones, from which Gaussians start


class Shot(NamedTuple):
    """A frame to write: its camera in the data set's units, and what reads or renders its picture,
    uint8 [H, W, 3 or 4]."""

    name: str
    camera: Camera
    picture: Callable[[], Tensor]


def export(scene: Scene, path: Trajectory, folder: Path, layout: str, log: Log) -> None:
    """Write `scene` and the frames of `path` into the new or empty `folder`, in a `layout` above.

    Raises SteerbenchError if a frame has no true picture, or the layout cannot hold a camera.
    """
    if folder.exists() and any(folder.iterdir()):
        raise unexpected(folder, "a new or an empty folder", "one with files")
    train = scene.splits["train"]
    learned = [partial(_read, train.images, number) for number in range(len(train))]
    known = {
        "train": _shots(scene, train.cameras, learned),
        "test": _shots(scene, [step.camera for step in path.steps], _true(scene, path)),
    }
    with explained(folder):
        LAYOUTS[layout](scene, known, folder, log)
        if layout == "nerfbaselines":
            cameras = [step.camera for step in path.steps]
            write_path(folder / "path.json", cameras, scene, form="nerfbaselines")


def _read(images: Sequence[Tensor], index: int) -> Tensor:
    return images[index]


def _true(scene: Scene, path: Trajectory) -> list[Callable[[], Tensor]]:
    """What reads or renders the true picture of each frame of `path`."""
    images = scene.splits[path.split].images
    pictures: list[Callable[[], Tensor]] = []
    for step in path.steps:
        if step.truth is not None:
            pictures.append(partial(_read, images, step.truth))
        elif scene.exact is not None:
            pictures.append(partial(scene.exact, step.camera))
        else:
            wanted = "a path whose frames all have true pictures, or an embedded scene"
            raise unexpected("--path", wanted, f"{path.name} on {scene.name}")
    return pictures


def _shots(
    scene: Scene, cameras: Sequence[Camera], pictures: Sequence[Callable[[], Tensor]]
) -> list[Shot]:
    moved = (move_camera(camera, scene.unit_length, scene.origin) for camera in cameras)
    named = enumerate(zip(moved, pictures, strict=True))
    return [Shot(f"{number:04}", camera, picture) for number, (camera, picture) in named]


def _blender(scene: Scene, known: Mapping[str, Sequence[Shot]], folder: Path, log: Log) -> None:
    lenses = {
        (x.width, x.height, x.fx, x.fy, x.cx, x.cy) for of in known.values() for _, x, _ in of
    }
    width, height, fx, *_ = first = min(lenses)
    centred = (width, height, fx, fx, width / 2, height / 2)
    if len(lenses) > 1 or not np.allclose(first, centred, rtol=1e-6):
        wanted = "centred pinholes of one size and focal length; --layout colmap takes others"
        raise unexpected("--layout", wanted, f"width, height, fx, fy, cx, cy = {lenses}")
    angle = 2 * math.atan(width / 2 / fx)
    for split, shots in known.items():
        _write_pictures(shots, folder / split, lambda picture: picture, log)
        frames = []
        for name, camera, _ in shots:
            pose = [*opengl_to_opencv(camera.c2w).tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append({"file_path": f"./{split}/{name}", "transform_matrix": pose})
        record = {"camera_angle_x": angle, "w": width, "h": height, "frames": frames}
        (folder / camera_file(split)).write_text(json.dumps(record, indent=1))


def _colmap(scene: Scene, known: Mapping[str, Sequence[Shot]], folder: Path, log: Log) -> None:
    def flat(picture: Tensor) -> Tensor:
        return torch.from_numpy(as_bytes(composite(picture, scene.background)))

    share = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))
    inside = scene.bounds[0] + share * (scene.bounds[1] - scene.bounds[0])
    points = (scene.origin + scene.unit_length * inside).tolist()
    for split, shots in known.items():
        place = folder / ("" if split == "train" else split)
        _write_pictures(shots, place / "images", flat, log)
        cameras, images = [], []
        for number, (name, camera, _) in enumerate(shots, 1):
            lens = camera.fx, camera.fy, camera.cx, camera.cy
            cameras.append(_line(number, "PINHOLE", camera.width, camera.height, *lens))
            rotation, centre = camera.c2w[:, :3].double().T, camera.c2w[:, 3].double()
            turn = Rotation.from_matrix(rotation.numpy()).as_quat(scalar_first=True).tolist()
            shift = (-rotation @ centre).tolist()  # world to camera
            images.append(_line(number, *turn, *shift, number, f"{name}.png") + "\n")
        model = place / "sparse" / "0"
        model.mkdir(parents=True)
        (model / "cameras.txt").write_text("".join(cameras))
        (model / "images.txt").write_text("".join(images))
        lines = (_line(n, *point, 128, 128, 128, 0) for n, point in enumerate(points, 1))
        (model / "points3D.txt").write_text("".join(lines))


def _nerfbaselines(
    scene: Scene, known: Mapping[str, Sequence[Shot]], folder: Path, log: Log
) -> None:
    first = known["train"][0].camera
    if first.width != first.height or not (scene.background == 1).all():
        got = f"{first.width} x {first.height} on {scene.background.tolist()}"
        raise unexpected("--layout nerfbaselines", "square pictures on white", got)
    _blender(scene, known, folder, log)
    info = {
        "loader": "nerfbaselines.datasets.blender:load_blender_dataset",
        "id": "steerbench",
        "scene": scene.name,
        "type": "object-centric",
        "evaluation_protocol": "default",
    }
    (folder / "nb-info.json").write_text(json.dumps(info, indent=1))


LAYOUTS = {"blender": _blender, "colmap": _colmap, "nerfbaselines": _nerfbaselines}


def _write_pictures(
    shots: Sequence[Shot], folder: Path, change: Callable[[Tensor], Tensor], log: Log
) -> None:
    folder.mkdir(parents=True)

    def write(shot: Shot) -> None:
        Image.fromarray(change(shot.picture()).numpy()).save(folder / f"{shot.name}.png")

    in_parallel(write, shots, f"write {folder.name}", log)


def _line(*words: object) -> str:
    return " ".join(map(str, words)) + "\n"
