"""The embedded scenes: exact colour, depth and opacity at any pose and any resolution.

A scene is written once, in NeRF-Synthetic's layout, and then read by that loader.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from bench.cameras import look_at, move_camera
from bench.scenes import blender
from bench.scenes.files import opengl_to_opencv, whole_number
from bench.scenes.medley import medley
from bench.scenes.models import MODELS
from bench.scenes.parallel import in_parallel
from bench.scenes.raytrace import Model, render
from bench.types import Camera, Frame, Log, Scene, SteerbenchError, Unavailable

ANGLE_X = 0.69
"""Horizontal field of view in radians."""

DISTANCE = 4.3
"""Of all cameras from the middle of the scene, in the model's units."""

MEDLEY = re.compile("medley-(0|[1-9][0-9]*)")
"""Names of the variants of `medley`."""


def load(
    name: str,
    *,
    width: int = 400,
    height: int | None = None,
    train: int = 60,
    test: int = 24,
    seed: int = 0,
    downscale: int = 1,
    background: str = "white",
    bounds: str | list = "auto",
    root: str | Path = "outputs/scenes",
    log: Log,
) -> Scene:
    """Read an embedded scene, after writing it if it is not there yet.

    Args:
        name: one of `MODELS`, or `medley-N` for variant N of the random heap.
        width, height: of its pictures; square when no height is given.
        train: pictures from all around, 10 degrees below to 80 above the horizon.
        test: pictures of a smooth orbit, 1 degree of azimuth apart: 360 of them close it.
        seed: of the training poses.
        downscale, background, bounds: as of `blender.load`.
        root: where scenes are written, each into a folder of its own.

    Raises SteerbenchError when an option is out of range or `root` cannot be written.
    """
    settings = {
        "name": name,
        "width": whole_number(width, "width", 1),
        "height": whole_number(width if height is None else height, "height", 1),
        "train": whole_number(train, "train", 1),
        "test": whole_number(test, "test", 1),
        "seed": whole_number(seed, "seed", 0),
    }
    find(name)
    folder = Path(root) / f"{name}-{settings_hash(settings)}"
    if not folder.is_dir():
        write(folder, settings, log)
    scene = blender.load(
        folder, downscale=downscale, background=background, bounds=bounds, name=name, log=log
    )
    return replace(scene, exact=lambda camera: exact_picture(scene, camera))


def load_medley(
    *,
    variant: int = 0,
    width: int = 400,
    height: int | None = None,
    train: int = 60,
    test: int = 24,
    seed: int = 0,
    downscale: int = 1,
    background: str = "white",
    bounds: str | list = "auto",
    root: str | Path = "outputs/scenes",
    log: Log,
) -> Scene:
    """Read a variant of the random heap; the other options are those of `load`."""
    return load(
        f"medley-{whole_number(variant, 'variant', 0)}",
        width=width,
        height=height,
        train=train,
        test=test,
        seed=seed,
        downscale=downscale,
        background=background,
        bounds=bounds,
        root=root,
        log=log,
    )


def find(name: str) -> Model:
    """The model of that name; Unavailable when there is none."""
    if match := MEDLEY.fullmatch(name):
        return medley(int(match[1]))
    if name not in MODELS:
        names = ", ".join((*MODELS, "medley-0, medley-1 and so on"))
        raise Unavailable(f"scene: expected one of {names}, got {name!r}")
    return MODELS[name]()


def render_exact(name: str, camera: Camera, *, background: float = 1.0, samples: int = 16) -> Frame:
    """The exact picture of a model.

    Args:
        name: as of `load`.
        camera: in the model's units, which are those of the written data set.
        background: the grey behind it, 1 for white.
        samples: rays a pixel, a power of two; 1 asks for the pixel centre's ray alone.

    Of a pixel's rays, `rgb` is the mean colour, `alpha` the mean opacity and `depth` the mean
    z-depth weighted by opacity, +inf where alpha is below EMPTY_ALPHA.
    """
    return render(find(name), camera, torch.full((3,), background), samples)


def exact_frame(scene: Scene, camera: Camera, *, samples: int = 16) -> Frame:
    """The exact picture of a loaded embedded scene, with `camera` and depth in scene units."""
    in_model = move_camera(camera, scene.unit_length, scene.origin)
    frame = render(find(scene.name), in_model, scene.background, samples)
    return Frame(frame.rgb, frame.depth / scene.unit_length, frame.alpha)


def exact_picture(scene: Scene, camera: Camera) -> Tensor:
    """The picture uint8 [H, W, 4] that a split of the scene would have at `camera`."""
    in_model = move_camera(camera, scene.unit_length, scene.origin)
    return to_rgba(render(find(scene.name), in_model, torch.zeros(3), samples=16))


def settings_hash(settings: dict) -> str:
    """Of the settings and of the sources that the pictures come from."""
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    here = Path(__file__).parent
    own = "medley" if MEDLEY.fullmatch(settings["name"]) else "models"
    for module in ("analytic", own, "raytrace", "solids", "opaque", "media", "textures"):
        digest.update((here / f"{module}.py").read_bytes())
    return digest.hexdigest()[:12]


def write(folder: Path, settings: dict, log: Log) -> None:
    """Render a scene and move it to `folder` when it is whole."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
            scene = Path(temporary) / "scene"
            write_pictures(scene, settings, log)
            try:
                scene.rename(folder)
            except OSError:
                if not folder.is_dir():  # else another process was faster
                    raise
    except OSError as error:
        raise SteerbenchError(f"{folder}: the scene cannot be written: {error}") from error


def write_pictures(folder: Path, settings: dict, log: Log) -> None:
    """Both splits in NeRF-Synthetic's layout."""
    model = find(settings["name"])
    width, height = settings["width"], settings["height"]
    focal = width / 2 / math.tan(ANGLE_X / 2)
    poses = {
        "train": train_poses(settings["train"], settings["seed"]),
        "test": orbit_poses(settings["test"]),
    }
    jobs = []
    for split, split_poses in poses.items():
        (folder / split).mkdir(parents=True)
        frames = []
        for number, pose in enumerate(split_poses):
            camera = Camera(pose.float(), focal, focal, width / 2, height / 2, width, height)
            jobs.append((camera, folder / split / f"r_{number}.png"))
            matrix = [*opengl_to_opencv(pose).tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append({"file_path": f"./{split}/r_{number}", "transform_matrix": matrix})
        record = {"camera_angle_x": ANGLE_X, "scene": settings, "frames": frames}
        (folder / blender.camera_file(split)).write_text(json.dumps(record, indent=1))

    def draw(job: tuple[Camera, Path]) -> None:
        camera, path = job
        picture = to_rgba(render(model, camera, torch.zeros(3), samples=16))
        Image.fromarray(picture.numpy()).save(path)

    in_parallel(draw, jobs, f"render {settings['name']}", log)


def to_rgba(frame: Frame) -> Tensor:
    """uint8 [H, W, 4] with straight alpha, of a frame on black."""
    alpha = frame.alpha[..., None]
    straight = frame.rgb / alpha.clamp(min=1e-6)
    return (torch.cat((straight, alpha), dim=-1).clamp(0, 1) * 255).round().to(torch.uint8)


def train_poses(count: int, seed: int) -> list[Tensor]:
    """Spread evenly over a zone of the sphere by the golden angle, from a seeded start."""
    phase, shift = torch.rand(2, generator=torch.Generator().manual_seed(seed)).tolist()
    low, high = math.sin(math.radians(-10)), math.sin(math.radians(80))
    golden = math.pi * (3 - math.sqrt(5))
    return [
        pose_on_sphere(
            2 * math.pi * phase + golden * k,
            math.asin(low + (high - low) * (k + shift) / count),
        )
        for k in range(count)
    ]


def orbit_poses(count: int) -> list[Tensor]:
    """1 degree of azimuth apart, centred on the front, swaying between 17 and 33 degrees above."""
    azimuths = [math.radians(-90 + k - (count - 1) / 2) for k in range(count)]
    return [pose_on_sphere(a, math.radians(25 + 8 * math.sin(2 * a))) for a in azimuths]


def pose_on_sphere(azimuth: float, elevation: float) -> Tensor:
    """Camera-to-world [3, 4] float64 at DISTANCE, looking at the middle, z up; radians."""
    level = math.cos(elevation)
    direction = (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation))
    eye = DISTANCE * torch.tensor(direction, dtype=torch.float64)
    return look_at(eye, torch.zeros_like(eye), eye.new_tensor((0, 0, 1)))
