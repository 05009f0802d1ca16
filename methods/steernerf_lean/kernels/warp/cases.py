"""Cases of the backward warping: agreement of the backends; the same view again.

Whether a pixel is valid depends on the side of the source picture's border on which it falls, and
rounding may decide that. So an agreement compares only pixels that rounding cannot move across the
border. Depths differ by much less or much more than `TOLERANCE`, so that rounding affects no other
decision.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from torch import Tensor
from torch.nn import functional

from bench.case import DTYPES, U32, Bound, Case, Given, Operation, Property, on_backends
from bench.cases import CAMERAS
from bench.types import Camera
from methods.kernels.dispatch import served
from methods.steernerf_lean.cells import centres
from methods.steernerf_lean.kernels.warp import enlarge, source_from_camera, warp

MEAN_ROUNDINGS = 8
"""Maximum number of operations, of relative error u each, from the depths to their mean: a weight
and its product, three sums, those of the weights, and the quotient, unless they cancel."""

ROUNDINGS = MEAN_ROUNDINGS + 9
"""The same number up to numerator and denominator of a coordinate: two more for a matrix entry, six
for the sum of products, one for their quotient and its difference to the centre of a pixel."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Kind:
    """A depth map [height, width] of a wavy wall at a depth of 2, and what it is warped with."""

    width: int = 24
    height: int = 17
    scale: int = 4
    turn: Vector = (0.0, 0.0, 0.0)  # rotation vector of the source, in radians
    move: Vector = (0.0, 0.0, 0.0)  # its offset
    holes: bool = False  # whether some pixels have no depth
    edge: float = 0.0  # how much farther away the right half of the depth map and one row are
    channels: int = 3  # of the picture
    every: int = 1  # only every n-th cell; 0: none


FRAME = "200 x 200 to 800 x 800"

KINDS = {
    "one pixel": Kind(1, 1, 1),
    "one channel": Kind(9, 7, 1, move=(0.02, 0.01, 0.0), channels=1),
    "seven channels": Kind(9, 7, 3, move=(0.02, 0.01, 0.0), channels=7),
    "turned": Kind(turn=(0.05, -0.04, 0.02), move=(-0.05, 0.1, 0.05)),
    "rolled": Kind(turn=(0.0, 0.0, 0.5 * math.pi)),
    "edges and holes": Kind(move=(0.03, 0.0, 0.1), edge=0.5, holes=True),
    "holes, NaN, 1e20 and 2": Kind(edge=1e20, holes=True),
    "leaving the picture": Kind(turn=(0.0, 0.2, 0.0)),
    "behind the source": Kind(turn=(0.0, math.pi, 0.0)),
    "partly behind the source": Kind(move=(0.0, 0.0, 2.25), edge=2.0),
    "half of it empty": Kind(edge=math.inf),
    "no depth": Kind(1, edge=math.inf),
    "some cells": Kind(move=(0.03, 0.0, 0.1), every=5),
    "no cell": Kind(every=0),
    FRAME: Kind(200, 200, turn=(0.02, -0.01, 0.0), move=(0.02, 0.0, 0.0), holes=True),
}


def _warped(given: Given, backend: str) -> tuple[Tensor, ...]:
    cells, scale, sure = (given[name] for name in ("cells", "scale", "sure"))
    fine = enlarge(given["depth"], cells, scale, backend=backend)
    view = given["source"], fine, cells, given["camera"], scale
    values, valid = warp(given["picture"], *view, backend=backend)
    return fine, values * sure[..., None], valid * sure


WARP = Operation(
    "warp",
    served(__package__),
    _warped,
    {
        "depth": Bound(
            "a mean has 8 roundings in each backend, and far depths take no part in it: 16 u",
            lambda given: 2 * MEAN_ROUNDINGS * U32 * given["fine"],
        ),
        "values": Bound(
            "a coordinate n / w of the place is off by 17 u (n' + |n / w| w') / w in each backend, "
            "n' and w' the sums of magnitudes; neighbours differ by at most 1, so a value by no "
            "more than its place along each axis; 8 roundings of its own",
            lambda given: given["off"][..., None] + 16 * U32,
        ),
        "valid": Bound("comparisons that rounding does not decide: 0", 0.0),
    },
)

BACK = "x, y and w rounded 6 times at the size of the picture, looked up twice: 24 reach + 8 u"


def cases() -> list[Case]:
    """Enlarging and warping by all backends; the same view again, from many cameras."""
    found = []
    for name, kind in KINDS.items():
        found += WARP.cases(name, partial(_given, kind), items=800**2 if name == FRAME else None)
    for name, camera in CAMERAS.items():
        reach = max(abs(camera.cx), abs(camera.cy), camera.width, camera.height)
        exact = () if camera.c2w[:, 3].any() else ("fp64",)  # where the pose is exact
        tolerances = on_backends(24 * reach + 8, *exact)
        same = Property("warp", "the picture is unchanged", BACK, tolerances)
        for depth in (1e-20, 1.0, 1e20):
            error = partial(_same_error, camera, depth)
            found.append(same.case(f"same pose, {name}, depth {depth:g}", error))
    return found


@cache
def _given(kind: Kind) -> Given:
    """The inputs; of each pixel, whether rounding leaves its validity as it is, and by how much the
    places that two backends look up may differ."""
    source, camera = _cameras(kind)
    depth, cells = _depth(kind), torch.arange(kind.width * kind.height)
    cells = cells[:: kind.every] if kind.every else cells[:0]
    shape = camera.height, camera.width, kind.channels
    picture = torch.rand(shape, generator=torch.Generator().manual_seed(kind.width + kind.scale))

    fine = enlarge(depth.double(), cells, kind.scale, backend="reference")
    matrix, offset = source_from_camera(source, camera)
    pixel = functional.pad(centres(cells, kind.width, kind.scale).double(), (0, 1), value=1.0)
    z = fine.nan_to_num(posinf=0)[..., None]
    x, w = (z * (pixel @ matrix.T) + offset).split((2, 1), dim=-1)
    x_size, w_size = (z * (pixel @ matrix.abs().T) + offset.abs()).split((2, 1), dim=-1)
    x = x / w
    off = 2 * ROUNDINGS * U32 * (x_size + x.abs() * w_size) / w.abs()
    to_border = torch.minimum(x.abs(), (x - torch.tensor((source.width, source.height))).abs())
    sure = ((w.abs() > ROUNDINGS * U32 * w_size) & (to_border > off)).all(dim=-1)
    known = fine.isfinite()
    return {
        **{"picture": picture, "source": source, "camera": camera},
        **{"depth": depth, "cells": cells, "scale": kind.scale},
        "sure": (sure | ~known).float(),
        "fine": z.squeeze(-1),
        "off": torch.where(sure & known, off.sum(dim=-1), 0),
    }


def _cameras(kind: Kind) -> tuple[Camera, Camera]:
    """The source and the camera, which is at the origin."""
    width, height = kind.width * kind.scale, kind.height * kind.scale
    pinhole = 1.2 * width, 1.2 * width, width / 2, height / 2
    camera = Camera(torch.eye(3, 4), *pinhole, width, height)
    turn, move = (torch.tensor(v, dtype=torch.float64) for v in (kind.turn, kind.move))
    skew = torch.linalg.cross(turn.expand(3, 3), torch.eye(3).double()).T
    c2w = torch.cat((torch.linalg.matrix_exp(skew), move[:, None]), dim=1).float()
    return replace(camera, c2w=c2w), camera


def _depth(kind: Kind) -> Tensor:
    row, column = torch.arange(kind.height)[:, None], torch.arange(kind.width)
    depth = 2 + 0.005 * torch.sin(0.9 * row + 0.7 * column)
    if kind.edge:
        behind = (column >= kind.width // 2) | (row == kind.height // 3)
        depth = torch.where(behind, depth + kind.edge, depth)
    if kind.holes:
        missing = (3 * row + column) % 7
        depth = torch.where(missing == 0, torch.inf, depth)
        depth = torch.where((missing == 3) & (row % 4 == 0), torch.nan, depth)
    return depth


def _same_error(camera: Camera, depth: float, backend: str, device: str, precision: str) -> float:
    """At constant depth; cells are pixels."""
    size = camera.height, camera.width
    picture = torch.rand(*size, 3, generator=torch.Generator().manual_seed(0)).to(DTYPES[precision])
    cells = torch.arange(size[0] * size[1], device=device)
    z = torch.full((len(cells), 1), depth, dtype=picture.dtype, device=device)
    values, valid = warp(picture.to(device), camera, z, cells, camera, 1, backend=backend)
    error = (values.view_as(picture).cpu() - picture).abs().max().item()
    return error if valid.all() else math.inf
