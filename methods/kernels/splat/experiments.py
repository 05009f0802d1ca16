"""Experiments on bringing a preceding frame into the present view.

The cameras look along z at a wall that stands across, so that what a pixel of one sees of the other
is known in closed form.
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
from methods.kernels.splat import gather, splat
from methods.kernels.warp import warp

WALL = 1.0
"""z-depth of the wall, scene units; the preceding camera's where the two differ."""

BESIDE = 0.02
"""How far beside the present camera the preceding one stands."""

NEARER = 1 / 16
"""How much nearer to the wall the present camera stands: a point moves by up to 1/30 of the
picture, and so comes to lie anywhere in a pixel."""


Brought = tuple[Callable[[], Tensor], Tensor]
"""What computes the colours of some pixels of the present view, and which these are."""


def experiments() -> list[Experiment]:
    """Error of the depth; size of the pixels that points are rounded to."""
    return [
        _depth_error(),
        _pixel_size("the nearest point of each pixel (splat)", _splatted),
        _pixel_size("looked up between four pixels (warp)", _warped),
    ]


def _depth_error() -> Experiment:
    """A picture whose colours are its own coordinates, looked up with a wrong depth."""
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
    """A smooth picture, brought into a view from nearer by."""
    trials = []
    for side in (32, 64, 128, 256, 512):
        preceding, present = _camera(side), _camera(side, z=NEARER)
        picture = _colour(_on_wall(preceding, WALL)).view(side, side, 1).float()
        call, seen = bring(picture, preceding, present)
        exact = _colour(_on_wall(present, WALL - NEARER))[seen]
        trials.append(Trial(1 / side, call, exact))
    return Experiment(f"colour: {name}", "pixel, sides of the picture", trials, (1 / 512, 1 / 64))


def _splatted(picture: Tensor, preceding: Camera, present: Camera) -> Brought:
    """The pixels that a point lands in."""
    side = preceding.width
    points = unproject(preceding, pixel_grid(side, side), torch.full((side**2,), WALL))
    pixels, depth = project(present, points)

    def shown() -> Tensor:
        return splat(pixels, depth, side, side).flatten()

    seen = shown() >= 0
    return lambda: gather(picture.view(-1, 1), shown())[seen, 0], seen


def _warped(picture: Tensor, preceding: Camera, present: Camera) -> Brought:
    """All pixels but those of the rim."""
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
    """x and y [H * W, 2] float64 of what the pixel centres see at `depth`."""
    pixels = pixel_grid(camera.width, camera.height).double()
    middle = pixels.new_tensor((camera.cx, camera.cy))
    return (pixels - middle) / camera.fx * depth + camera.c2w[:2, 3].double()


def _colour(places: Tensor) -> Tensor:
    """A smooth pattern on the wall, three waves across the picture: [N] in [0, 1]."""
    waves = torch.sin(2 * math.pi * 3 * places)
    return 0.5 + waves[:, 0] * waves[:, 1] / 2
