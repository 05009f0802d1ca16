"""Experiments on reprojecting a preceding frame into the current view.

The cameras look along z at a perpendicular wall, so that the mapping between their pixels is known
in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.accuracy import Experiment, Trial
from bench.cameras import pixel_grid, project, unproject
from bench.types import Camera
from methods.steernerf.kernels.splat import gather, splat
from methods.steernerf_lean.kernels.warp import warp

WALL = 1.0
"""z-depth of the wall in scene units, for the preceding camera if the two differ."""

BESIDE = 0.02
"""Sideways offset of the preceding camera from the current one, scene units."""

NEARER = 1 / 16
"""How much nearer to the wall the current camera is, scene units. Points move by up to 1/30 of the
picture, so that they may land anywhere in a pixel."""


Brought = tuple[Callable[[], Tensor], Tensor]
"""A function that computes colours of some pixels of the current view, and which pixels."""


def experiments() -> list[Experiment]:
    """Experiments on the error of the depth, and on the pixel size that points are rounded to."""
    return [
        _depth_error(),
        _pixel_size("the nearest point of each pixel (splat)", _splatted),
        _pixel_size("looked up between four pixels (warp)", _warped),
    ]


def _depth_error() -> Experiment:
    """Look up a picture whose colours are its own coordinates, with a wrong depth."""
    side = 256
    present, preceding = _camera(side), _camera(side, x=BESIDE)
    coordinates = pixel_grid(side, side)
    picture = torch.nn.functional.pad(coordinates, (0, 1)).view(side, side, 3)
    shift = present.fx * BESIDE / WALL
    cells = (coordinates[:, 0] > 2 * shift).nonzero().squeeze(1)  # seen by both
    exact = coordinates[cells].double() - torch.tensor([shift, 0.0])

    def looked_up(error: float) -> Tensor:
        depth = torch.full((len(cells), 1), WALL * (1 + error))
        values, _ = warp(picture, preceding, depth, cells, present, 1)
        return values[:, 0, :2]

    errors = [10.0**-power for power in range(6, 0, -1)]
    trials = [Trial(error, partial(looked_up, error), exact) for error in errors]
    name = "where a pixel is looked up, in pixels"
    return Experiment(name, "relative error of the depth", trials, (1e-4, 1e-1))


def _pixel_size(name: str, bring: Callable[[Tensor, Camera, Camera], Brought]) -> Experiment:
    """Reproject a smooth picture into a view from nearer."""
    trials = []
    for side in (32, 64, 128, 256, 512):
        preceding, present = _camera(side), _camera(side, z=NEARER)
        picture = _colour(_on_wall(preceding, WALL)).view(side, side, 1).float()
        call, seen = bring(picture, preceding, present)
        exact = _colour(_on_wall(present, WALL - NEARER))[seen]
        trials.append(Trial(1 / side, call, exact))
    return Experiment(f"colour: {name}", "pixel, sides of the picture", trials, (1 / 512, 1 / 64))


def _splatted(picture: Tensor, preceding: Camera, present: Camera) -> Brought:
    """Splat; yields the pixels in which a point lands."""
    side = preceding.width
    points = unproject(preceding, pixel_grid(side, side), torch.full((side**2,), WALL))
    pixels, depth = project(present, points)

    def shown() -> Tensor:
        return splat(pixels, depth, side, side).flatten()

    seen = shown() >= 0
    return lambda: gather(picture.view(-1, 1), shown())[seen, 0], seen


def _warped(picture: Tensor, preceding: Camera, present: Camera) -> Brought:
    """Warp backward; yields all pixels except those at the rim."""
    side = preceding.width
    rim = torch.zeros(side, side, dtype=torch.bool)
    rim[1:-1, 1:-1] = True
    cells = rim.flatten().nonzero().squeeze(1)
    depth = torch.full((len(cells), 1), WALL - NEARER)
    return lambda: warp(picture, preceding, depth, cells, present, 1)[0][:, 0, 0], cells


def _camera(side: int, x: float = 0.0, z: float = 0.0) -> Camera:
    pose = torch.eye(3, 4)
    pose[0, 3], pose[2, 3] = x, z
    return Camera(pose, float(side), float(side), side / 2, side / 2, side, side)


def _on_wall(camera: Camera, depth: float) -> Tensor:
    """x and y [H * W, 2] float64 of the points that pixel centres see at `depth`."""
    pixels = pixel_grid(camera.width, camera.height).double()
    middle = pixels.new_tensor((camera.cx, camera.cy))
    return (pixels - middle) / camera.fx * depth + camera.c2w[:2, 3].double()


def _colour(places: Tensor) -> Tensor:
    """A smooth pattern on the wall, three waves across the picture: [N] in [0, 1]."""
    waves = torch.sin(2 * math.pi * 3 * places)
    return 0.5 + waves[:, 0] * waves[:, 1] / 2
