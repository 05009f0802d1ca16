"""The embedded scenes: exact colour, depth and opacity at any pose and resolution.

A scene is written once in NeRF-Synthetic's layout, then read by the loader of that layout.
"""

import hashlib
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from bench.cameras import look_at, move_camera
from bench.provenance import digest
from bench.scenes import blender
from bench.scenes.embedded.models import MODELS
from bench.scenes.embedded.raytrace import SceneModel, Solids, render
from bench.scenes.files import opengl_to_opencv, whole_number
from bench.sharing import check_sums, write_sums
from bench.threads import in_parallel
from bench.types import Camera, Log, Scene, SteerbenchError, Unavailable

ANGLE = 0.69  # field of view across the shorter side of a picture, in radians
DISTANCE = 4.3  # of all cameras from the centre of the scene, in the model's units
WIDTH, TRAIN, TEST = 400, 60, 24  # of what a scene has that is called like its model alone


def load(
    name: str,  # one of `MODELS`
    *,
    width: int = WIDTH,
    height: int | None = None,  # None: square pictures
    train: int = TRAIN,
    test: int = TEST,
    seed: int = 0,  # of the training poses
    downscale: int = 1,
    background: str = "white",
    bounds: str | list = "auto",
    root: str | Path = "outputs/scenes",  # holds a folder for each scene
    log: Log,
) -> Scene:
    """Read an embedded scene; write it first if it does not exist yet.

    `train` pictures come from all around, 10 degrees below to 80 degrees above the horizon; `test`
    pictures from a smooth orbit, 1 degree of azimuth apart (360 close it). For `downscale`,
    `background` and `bounds` see `blender.load`. Sizes other than the defaults, and a seed, stand
    in the scene's name, for it is another scene. Raises SteerbenchError when an option is out of
    range or `root` cannot be written.
    """
    sizes = {"width": width, "height": width if height is None else height, "train": train}
    numbers = {**sizes, "test": test, "seed": seed}
    checked = {key: whole_number(x, key, int(key != "seed")) for key, x in numbers.items()}
    settings = {"name": name, **checked}
    model = find(name)
    key = f"{json.dumps(settings, sort_keys=True)} {digest(write)}"
    folder = Path(root) / f"{name}-{hashlib.sha256(key.encode()).hexdigest()[:12]}"
    if not folder.is_dir():
        write(folder, settings, log)
    check_sums(folder)
    scene = blender.load(
        folder,
        downscale=downscale,
        background=background,
        bounds=bounds,
        name=_title(name, **checked),
        log=log,
    )

    corner = scene.origin.float()  # rounded as in all figures that are stored

    def exact(camera: Camera) -> Tensor:
        return picture(model, move_camera(camera, scene.unit_length, corner))

    def surface(camera: Camera) -> Tensor:
        moved = move_camera(camera, scene.unit_length, corner)
        with torch.no_grad():
            return render(model, moved, samples=1).depth / scene.unit_length

    return replace(scene, exact=exact, surface=surface if isinstance(model, Solids) else None)


def _title(name: str, width: int, height: int, train: int, test: int, seed: int) -> str:
    """The name of a scene of these settings in result rows."""
    sizes = f"-{width}x{height}" if (width, height) != (WIDTH, WIDTH) else ""
    sizes += f"-{train}train" if train != TRAIN else ""
    sizes += f"-{test}test" if test != TEST else ""
    return name + sizes + (f"-seed{seed}" if seed else "")


def find(name: str) -> SceneModel:
    """The model called `name`; raises Unavailable if there is none."""
    if name not in MODELS:
        raise Unavailable(f"scene: expected one of {', '.join(MODELS)}, got {name!r}")
    return MODELS[name]()


def picture(model: SceneModel, camera: Camera) -> Tensor:
    """The exact picture, uint8 [H, W, 4] with straight alpha; `camera` is in the model's units."""
    with torch.inference_mode():  # with less bookkeeping, threads wait less for Python's lock
        frame = render(model, camera, samples=16)
        alpha = frame.alpha[..., None]
        straight = frame.rgb / alpha.clamp(min=1e-6)
        pixels = (torch.cat((straight, alpha), dim=-1).clamp(0, 1) * 255).round().to(torch.uint8)
    return pixels.clone()  # an ordinary tensor


def write(folder: Path, settings: dict, log: Log) -> None:
    """Render a scene in NeRF-Synthetic's layout, and move it to `folder` once complete."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}-") as temporary:
            _write_pictures(scene := Path(temporary) / "scene", settings, log)
            write_sums(scene)
            scene.rename(folder)
    except OSError as error:
        if folder.is_dir():  # another process was faster
            return
        raise SteerbenchError(f"{folder}: the scene cannot be written: {error}") from error


def _write_pictures(folder: Path, settings: dict, log: Log) -> None:
    model, width, height = find(settings["name"]), settings["width"], settings["height"]
    focal = min(width, height) / 2 / math.tan(ANGLE / 2)
    train = train_poses(settings["train"], settings["seed"])
    jobs = []
    for split, poses in (("train", train), ("test", orbit_poses(settings["test"]))):
        (folder / split).mkdir(parents=True)
        frames = []
        for number, pose in enumerate(poses):
            camera = Camera(pose.float(), focal, focal, width / 2, height / 2, width, height)
            jobs.append((camera, folder / split / f"r_{number}.png"))
            matrix = [*opengl_to_opencv(pose).tolist(), [0.0, 0.0, 0.0, 1.0]]
            frames.append({"file_path": f"./{split}/r_{number}", "transform_matrix": matrix})
        angle = 2 * math.atan(width / 2 / focal)
        record = {"camera_angle_x": angle, "scene": settings, "frames": frames}
        (folder / blender.camera_file(split)).write_text(json.dumps(record, indent=1))

    def draw(job: tuple[Camera, Path]) -> None:
        camera, path = job
        Image.fromarray(picture(model, camera).numpy()).save(path)

    in_parallel(draw, jobs, f"render {settings['name']}", log)


def train_poses(count: int, seed: int) -> list[Tensor]:
    """Poses spread evenly over a zone of the sphere by the golden angle; `seed` sets the start."""
    phase, shift = torch.rand(2, generator=torch.Generator().manual_seed(seed)).tolist()
    low, high = (math.sin(math.radians(x)) for x in (-10.0, 80.0))
    golden = math.pi * (3 - math.sqrt(5))
    heights = (math.asin(low + (high - low) * (k + shift) / count) for k in range(count))
    return [pose_on_sphere(2 * math.pi * phase + golden * k, h) for k, h in enumerate(heights)]


def orbit_poses(count: int) -> list[Tensor]:
    """Poses 1 degree of azimuth apart, centred on the front, that rise and fall twice a turn."""
    azimuths = [math.radians(-90 + k - (count - 1) / 2) for k in range(count)]
    return [pose_on_sphere(a, math.radians(25.0 + 8.0 * math.sin(2 * a))) for a in azimuths]


def pose_on_sphere(azimuth: float, elevation: float) -> Tensor:
    """Camera-to-world [3, 4] float64 that looks at the centre from `DISTANCE`, z up; radians."""
    level = math.cos(elevation)
    direction = (level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation))
    eye = DISTANCE * torch.tensor(direction, dtype=torch.float64)
    return look_at(eye, torch.zeros_like(eye), eye.new_tensor((0, 0, 1)))
