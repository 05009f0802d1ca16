"""Writes a scene with a path and its true pictures, for other programs to train on and to render.

The pictures to learn from are those of the training split, the frames of the path the test split.

- `blender`: NeRF-Synthetic's, `transforms_{train,test}.json` beside RGBA pictures.
- `colmap`: `images` and `sparse/0`, only of the training pictures: programs that hold out every
  eighth picture themselves would train on the others of a path. The path is a capture of its own,
  in `test`. The points are random ones in the scene's bounds.
- `nerfbaselines`: as `blender`, with `nb-info.json`, and the path as `path.json`.
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from bench.errors import explained, unexpected
from bench.metrics import as_bytes
from bench.paths import write_path
from bench.scenes.export import data_camera, write_blender
from bench.threads import in_parallel
from bench.trajectories import Trajectory
from bench.types import Log, Scene, Split, composite

POINTS = 10_000  # random ones, from which Gaussians start


def export(scene: Scene, path: Trajectory, folder: Path, layout: str, log: Log) -> None:
    """Write `scene` and the frames of `path` into the new or empty `folder`, in a `layout` above.

    Raises SteerbenchError if a frame has no true picture, or the layout cannot hold the scene.
    """
    if folder.exists() and any(folder.iterdir()):
        raise unexpected(folder, "a new or an empty folder", "one with files")
    cameras = [step.camera for step in path.steps]
    names = list(map(str, range(len(cameras))))
    splits = {"train": scene.splits["train"], "test": Split(cameras, _Truths(scene, path), names)}
    with explained(folder):
        LAYOUTS[layout](replace(scene, splits=splits), folder, log)


class _Truths(Sequence[Tensor]):
    """The true pictures of a path, each read or rendered when it is asked for."""

    def __init__(self, scene: Scene, path: Trajectory) -> None:
        self._known, self._exact, self._steps = scene.splits[path.split], scene.exact, path.steps
        if self._exact is None and any(step.truth is None for step in path.steps):
            wanted = "a path whose frames all have true pictures, or an embedded scene"
            raise unexpected("--path", wanted, f"{path.name} on {scene.name}")

    def __len__(self) -> int:
        return len(self._steps)

    def __getitem__(self, number: Any) -> Any:
        step = self._steps[number]
        if step.truth is not None:
            return self._known.images[step.truth]
        assert self._exact is not None
        return self._exact(step.camera)


def _blender(scene: Scene, folder: Path, log: Log) -> None:
    write_blender(scene, folder, {"train": "train", "test": "test"}, log)


def _colmap(scene: Scene, folder: Path, log: Log) -> None:
    share = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))
    inside = scene.bounds[0] + share * (scene.bounds[1] - scene.bounds[0])
    points = (scene.origin + scene.unit_length * inside).tolist()
    for name, split in scene.splits.items():
        place = folder / ("" if name == "train" else name)
        model = place / "sparse" / "0"
        pictures = place / "images"
        for made in (model, pictures):
            made.mkdir(parents=True)

        def write(number: int, split: Split = split, pictures: Path = pictures) -> None:
            flat = as_bytes(composite(split.images[number - 1], scene.background))
            Image.fromarray(flat).save(pictures / f"{number:04}.png")

        numbers = range(1, len(split) + 1)
        cameras = []
        images = []
        in_parallel(write, numbers, f"write {name}", log)
        for number, seen in zip(numbers, split.cameras, strict=True):
            camera = data_camera(scene, seen)
            cameras.append(_line(number, "PINHOLE", *camera.size, *camera.intrinsics))
            pose = camera.c2w.numpy()
            turn = Rotation.from_matrix(pose[:, :3].T)  # world to camera, exactly a rotation
            shift = turn.apply(-pose[:, 3])
            turned = turn.as_quat(scalar_first=True)
            images.append(_line(number, *turned, *shift, number, f"{number:04}.png") + "\n")
        (model / "cameras.txt").write_text("".join(cameras))
        (model / "images.txt").write_text("".join(images))
        lines = (_line(n, *point, 128, 128, 128, 0) for n, point in enumerate(points, 1))
        (model / "points3D.txt").write_text("".join(lines))


def _nerfbaselines(scene: Scene, folder: Path, log: Log) -> None:
    first = scene.splits["train"].cameras[0]
    if first.width != first.height or not (scene.background == 1).all():
        got = f"{first.width} x {first.height} on {scene.background.tolist()}"
        raise unexpected("--layout nerfbaselines", "square pictures on white", got)
    _blender(scene, folder, log)
    info = {
        "loader": "nerfbaselines.datasets.blender:load_blender_dataset",
        "id": "steerbench",
        "scene": scene.name,
        "type": "object-centric",
        "evaluation_protocol": "default",
    }
    (folder / "nb-info.json").write_text(json.dumps(info, indent=1))
    write_path(folder / "path.json", scene.splits["test"].cameras, scene, nerfbaselines=True)


LAYOUTS = {"blender": _blender, "colmap": _colmap, "nerfbaselines": _nerfbaselines}


def _line(*words: object) -> str:
    return " ".join(map(str, words)) + "\n"
