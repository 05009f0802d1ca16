"""Writes a scene as files for other programs, in the units of its data set."""

import json
import math
from collections.abc import Mapping
from pathlib import Path

import torch
from PIL import Image

from bench.cameras import move_camera
from bench.scenes.blender import camera_file
from bench.scenes.files import opengl_to_opencv
from bench.threads import in_parallel
from bench.types import Camera, Log, Scene, Split


def data_camera(scene: Scene, camera: Camera) -> Camera:
    """A `camera` in scene units as the data set has it; its pose is float64."""
    return move_camera(camera, scene.unit_length, scene.origin, torch.float64)


def picture_file(split: str, number: int) -> str:
    """Where a picture of a split is, below the folder that `write_blender` writes."""
    return f"{split}/r_{number}.png"


def write_blender(scene: Scene, folder: Path, files: Mapping[str, str], log: Log) -> None:
    """Write splits of `scene` in NeRF-Synthetic's layout into the empty `folder`.

    `files` says of which split the cameras in each `transforms_NAME.json` are: several names may
    show the same pictures, and a split that is not named is not written. Pictures are RGBA; opaque
    where the data set has no alpha. Masks are not written, which is logged. Beside
    `camera_angle_x`, the files have the intrinsics in the names of instant-ngp and nerfstudio, for
    each frame if they differ. Readers that know only `camera_angle_x` fail where it does not say
    all, because it is missing there.
    """
    if any(scene.splits[split].masks for split in files.values()):
        log.info(f"{folder}: without the masks of {scene.name}")
    for split in sorted(set(files.values())):
        (folder / split).mkdir(parents=True)

        def write(number: int, split: str = split, given: Split = scene.splits[split]) -> None:
            pixels = given.images[number]
            if pixels.shape[2] == 3:
                pixels = torch.cat((pixels, torch.full_like(pixels[..., :1], 255)), dim=2)
            file = folder / picture_file(split, number)
            Image.fromarray(pixels.numpy()).save(file, compress_level=1)  # quickly

        in_parallel(write, range(len(scene.splits[split])), f"write pictures of {scene.name}", log)
    for name, split in files.items():
        cameras = [data_camera(scene, camera) for camera in scene.splits[split].cameras]
        record = _transforms(cameras, split)
        (folder / camera_file(name)).write_text(json.dumps(record, indent=1) + "\n")


def _transforms(cameras: list[Camera], split: str) -> Mapping[str, object]:
    lenses = [_lens(camera) for camera in cameras]
    alike = all(lens == lenses[0] for lens in lenses)
    frames = []
    for number, (camera, lens) in enumerate(zip(cameras, lenses, strict=True)):
        pose = opengl_to_opencv(camera.c2w).tolist()  # its own inverse: it flips two axes
        path = picture_file(split, number).removesuffix(".png")
        frame = {"file_path": f"./{path}", "transform_matrix": [*pose, [0.0, 0.0, 0.0, 1.0]]}
        frames.append(frame if alike else {**frame, **lens})
    if not alike:
        return {"frames": frames}
    first, angle = cameras[0], {}
    centred = (first.cx, first.cy) == (first.width / 2, first.height / 2)
    if centred and first.fx == first.fy:
        angle["camera_angle_x"] = 2 * math.atan(first.width / 2 / first.fx)
    return {**angle, **lenses[0], "frames": frames}


def _lens(camera: Camera) -> dict[str, float]:
    sizes = {"w": camera.width, "h": camera.height}
    return {**sizes, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
