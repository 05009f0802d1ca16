"""Cases of the backward warping.

Whether a pixel is valid depends on which side of the source picture's border it falls, which
rounding may decide: a case looks only at the pixels that it cannot move over the border. Depths
differ by much less or much more than `TOLERANCE`, so that rounding decides nothing else.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from bench.cameras import pixel_grid, project, scale_camera, unproject
from bench.types import Camera
from methods.kernels.case import U32, Case, Prepared
from methods.kernels.warp import _source_from_camera, enlarge, warp

LOW, HIGH = 200, 800
"""Side of the depth and of the picture, in pixels."""

CHANNELS = 3
MIDDLE = 2.0
"""Depth of the wall that most cases look at."""

MEAN_ROUNDINGS = 8
"""Most operations, of relative error u each, from the depths to their mean: a weight and its
product, three sums, those of the weights and the quotient, as far as they do not cancel."""

ROUNDINGS = 8 + MEAN_ROUNDINGS
"""The same from the inputs to a coordinate's numerator and denominator: two for a matrix entry, six
for the sum of products, and those of the mean depth."""


def cases() -> list[Case]:
    """Cameras that rest, move, turn and roll; holes, edges, phases; what cannot be seen; a frame.

    A kind has the size of its depth, the scale and options: `turn`, a rotation vector of the
    source, in radians; `move`, its offset along the axes of the camera; `zoom`, its focal length
    over the camera's; `holes` and `edge` in the depth; `phase`; `channels`; `every`: only every
    so many-th cell is looked at, 0: none.
    """
    kinds: list[tuple[str, int, int, int, dict]] = [
        ("one pixel", 1, 1, 1, {}),
        ("one channel", 9, 7, 4, {"move": (0.02, 0.01, 0.0), "channels": 1}),
        ("seven channels", 9, 7, 3, {"move": (0.02, 0.01, 0.0), "channels": 7}),
        ("turned", 24, 17, 4, {"turn": (0.05, -0.04, 0.02), "move": (-0.05, 0.1, 0.05)}),
        ("rolled", 24, 17, 4, {"turn": (0.0, 0.0, 0.5 * math.pi)}),
        ("phase", 24, 17, 4, {"move": (0.03, 0.0, 0.0), "phase": (1.5, -0.5)}),
        ("phase of a whole pixel", 24, 17, 3, {"move": (0.03, 0.0, 0.0), "phase": (-3.0, 3.0)}),
        ("holes", 24, 17, 4, {"move": (0.03, 0.0, 0.1), "holes": True}),
        ("holes and a phase", 24, 17, 4, {"move": (0.03, 0, 0), "holes": True, "phase": (-1.5, 0)}),
        ("edges", 24, 17, 4, {"move": (0.03, 0.0, 0.1), "edge": 0.5}),
        ("edges and a phase", 24, 17, 4, {"edge": 0.5, "holes": True, "phase": (0.5, 1.5)}),
        ("leaving the picture", 24, 17, 4, {"turn": (0.0, 0.2, 0.0), "zoom": 2.0}),
        ("behind the source", 24, 17, 4, {"turn": (0.0, math.pi, 0.0)}),
        ("partly behind the source", 24, 17, 4, {"move": (0.0, 0.0, 2.25), "edge": 2.0}),
        ("half of it empty", 24, 17, 4, {"edge": math.inf}),
        ("nothing known", 1, 17, 4, {"edge": math.inf}),
        ("some cells", 24, 17, 4, {"move": (0.03, 0.0, 0.1), "every": 5}),
    ]
    depth_kinds: list[tuple[str, int, int, int, dict]] = [
        ("one pixel", 1, 1, 4, {}),
        ("one of one", 9, 7, 1, {}),
        ("three by three", 9, 7, 3, {}),
        ("phase", 24, 17, 4, {"phase": (1.5, -0.5)}),
        ("phase of a whole pixel", 24, 17, 3, {"phase": (-3.0, 3.0)}),
        ("holes and a phase", 24, 17, 4, {"holes": True, "phase": (-1.5, 0)}),
        ("edges and holes", 24, 17, 4, {"edge": 0.5, "holes": True}),
        ("half of it empty", 24, 17, 4, {"edge": math.inf}),
        ("nothing known", 1, 17, 4, {"edge": math.inf}),
        ("some cells", 24, 17, 4, {"every": 5}),
        ("no cell", 24, 17, 4, {"every": 0}),
    ]
    found = [
        Case(
            kernel,
            name,
            "fp32",
            len(_cells(width, height, options)) * scale**2,
            partial(prepare, width, height, scale, options),
        )
        for kernel, prepare, some in (
            ("warp", _prepare, kinds),
            ("warp enlarge", _prepare_enlarge, depth_kinds),
        )
        for name, width, height, scale, options in some
    ]
    moved = {"turn": (0.02, -0.01, 0.0), "move": (0.02, 0.0, 0.0), "holes": True}
    frame = f"{LOW} x {LOW} to {HIGH} x {HIGH}"
    for kernel, prepare in (("warp", _prepare), ("warp enlarge", _prepare_enlarge)):
        timed = partial(prepare, LOW, LOW, HIGH // LOW, moved)
        found.append(Case(kernel, frame, "fp32", HIGH**2, timed, timed=True))
    return found


def _camera(width: int, height: int) -> Camera:
    pose = torch.eye(3, 4)
    return Camera(pose, 1.2 * width, 1.2 * width, width / 2, height / 2, width, height)


def _source(camera: Camera, options: dict) -> Camera:
    """The camera, turned by a rotation vector about its axes, then moved along them."""
    x, y, z = options.get("turn", (0.0, 0.0, 0.0))
    skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    move = torch.tensor(options.get("move", (0.0, 0.0, 0.0)), dtype=torch.float64)
    c2w = torch.cat((torch.linalg.matrix_exp(skew), move[:, None]), dim=1).float()
    zoom = options.get("zoom", 1.0)
    return replace(camera, c2w=c2w, fx=zoom * camera.fx, fy=zoom * camera.fy)


def _depth(width: int, height: int, options: dict) -> Tensor:
    """A wavy wall; its right half and a row lie `edge` farther; some pixels have no depth."""
    row, column = torch.arange(height)[:, None], torch.arange(width)
    depth = MIDDLE + 0.005 * torch.sin(0.9 * row + 0.7 * column)
    if "edge" in options:
        behind = (column >= width // 2) | (row == height // 3)
        depth = torch.where(behind, depth + options["edge"], depth)
    if options.get("holes"):
        missing = (3 * row + column) % 7
        depth = torch.where(missing == 0, torch.inf, depth)
        depth = torch.where((missing == 3) & (row % 4 == 0), torch.nan, depth)
    return depth


def _cells(width: int, height: int, options: dict) -> Tensor:
    every = options.get("every", 1)
    return torch.arange(width * height)[::every] if every else torch.arange(0)


def _prepare(width: int, height: int, scale: int, options: dict, device: str) -> Prepared:
    camera = _camera(width * scale, height * scale)
    source = _source(camera, options)
    depth, phase = _depth(width, height, options), options.get("phase", (0.0, 0.0))
    shape = camera.height, camera.width, options.get("channels", CHANNELS)
    picture = torch.rand(shape, generator=torch.Generator().manual_seed(width + scale))
    shift = _position_error(source, camera, depth, scale)
    cells = _cells(width, height, options)
    sure = _sure(source, camera, depth, cells, scale, phase, shift).to(device)
    picture, depth, cells = picture.to(device), depth.to(device), cells.to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        fine = enlarge(depth, cells, scale, phase, backend=backend)
        values, valid = warp(picture, source, fine, cells, camera, scale, backend=backend)
        return values * sure[..., None], valid * sure

    # Neighbours differ by 1 at most, so a value by no more than its place along each axis; and it
    # is a sum of products, 8 roundings in either backend.
    return Prepared(call, 2 * shift + 16 * U32)


def _prepare_enlarge(width: int, height: int, scale: int, options: dict, device: str) -> Prepared:
    depth = _depth(width, height, options)
    known = depth[depth.isfinite()]
    farthest = known.max().item() if len(known) else 0.0
    depth, phase = depth.to(device), options.get("phase", (0.0, 0.0))
    cells = _cells(width, height, options).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        # No depth is 0: a finite number in its place can be compared.
        z = enlarge(depth, cells, scale, phase, backend=backend)
        return (z.nan_to_num(nan=-1.0, posinf=0.0),)

    return Prepared(call, 2 * MEAN_ROUNDINGS * U32 * farthest)


def _position_error(source: Camera, camera: Camera, depth: Tensor, scale: int) -> float:
    """How far apart, in pixels, two backends may look up the same pixel.

    A coordinate is x = n / w. Each of the two is a sum of products, off by `ROUNDINGS` u of the sum
    of their sizes n' and w', so x is off by (n' + |x| w') / w of that. All are at most as large as
    in the last corner of the picture at the largest depth, but for w, which is as small as at any
    pixel.
    """
    low = scale_camera(camera, depth.shape[1], depth.shape[0])
    known = depth.flatten().isfinite()
    points = unproject(low, pixel_grid(low.width, low.height)[known], depth.flatten()[known])
    _, ahead = project(source, points)
    ahead = ahead[ahead > 0].double()
    if len(ahead) == 0:
        return 0.0
    matrix, offset = (part.abs() for part in _source_from_camera(source, camera))
    farthest = depth[depth.isfinite()].max()
    corner = torch.tensor((camera.width, camera.height, 1.0), dtype=torch.float64)
    across, down, along = farthest * (matrix @ corner) + offset
    worst = torch.maximum(across + source.width * along, down + source.height * along)
    # A pixel takes its depth from centres less than two low-resolution pixels away.
    least = ahead.min() - farthest * 2 * scale * matrix[2, :2].sum()
    return 2 * ROUNDINGS * U32 * (worst / least).item()


def _sure(
    source: Camera,
    camera: Camera,
    depth: Tensor,
    cells: Tensor,
    scale: int,
    phase: tuple[float, float],
    margin: float,
) -> Tensor:
    """[N, s^2] pixels that stay valid, or not, when the source picture shifts by `margin`."""
    picture = torch.ones(source.height, source.width, 1, dtype=torch.float64)
    fine = enlarge(depth.double(), cells, scale, phase, backend="reference")
    shifts = [(margin, 0.0), (-margin, 0.0), (0.0, margin), (0.0, -margin)]
    valid = [
        warp(
            picture,
            replace(source, cx=source.cx + right, cy=source.cy + down),
            fine,
            cells,
            camera,
            scale,
            backend="reference",
        )[1]
        for right, down in shifts
    ]
    return (torch.stack(valid) == valid[0]).all(dim=0).float()
