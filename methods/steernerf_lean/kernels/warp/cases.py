"""Cases of the backward warping: agreement of the backends, same and opposite views, a long walk.

Whether a pixel is valid depends on the side of the source picture's border on which it falls, and
rounding may decide that. So an agreement compares only pixels that rounding cannot move across the
border. Depths differ by much less or much more than `TOLERANCE`, so that rounding affects no other
decision.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from bench.cameras import look_at, pixel_grid, project, scale_camera, unproject
from bench.case import DTYPES, U32, Agreement, Case, Prepare, Property, on_backends
from bench.cases import CAMERAS
from bench.types import Camera
from methods.kernels.dispatch import served
from methods.steernerf.kernels.splat.cases import ROLLED, TURNED, rotated
from methods.steernerf_lean.kernels.warp import enlarge, source_from_camera, warp

LOW, HIGH = 200, 800
"""Sides of the depth map and of the picture, in pixels."""

MIDDLE = 2.0
"""Depth of the wall that most cases look at."""

MEAN_ROUNDINGS = 8
"""Maximum number of operations, of relative error u each, from the depths to their mean: a weight
and its product, three sums, those of the weights, and the quotient, unless they cancel."""

ROUNDINGS = 8 + MEAN_ROUNDINGS
"""The same number from the inputs to numerator and denominator of a coordinate: two for a matrix
entry, six for the sum of products, and those of the mean depth."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Kind:
    """Inputs of an agreement.

    Attributes:
        width, height: size of the depth map.
        scale: s.
        turn: rotation vector of the source, in radians.
        move: offset of the source along the axes of the camera.
        zoom: focal length of the source over that of the camera.
        holes: whether some pixels have no depth.
        edge: how much farther away the right half of the depth map and one row are.
        channels: channels of the picture.
        every: warp only every n-th cell; 0: none.
    """

    width: int
    height: int
    scale: int
    turn: Vector = (0.0, 0.0, 0.0)
    move: Vector = (0.0, 0.0, 0.0)
    zoom: float = 1.0
    holes: bool = False
    edge: float = 0.0
    channels: int = 3
    every: int = 1

    @property
    def camera(self) -> Camera:
        """The view, at the origin."""
        width, height = self.width * self.scale, self.height * self.scale
        pose = torch.eye(3, 4)
        return Camera(pose, 1.2 * width, 1.2 * width, width / 2, height / 2, width, height)

    @property
    def source(self) -> Camera:
        """The camera, turned about its axes, then moved along them."""
        (x, y, z), camera = self.turn, self.camera
        skew = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        move = torch.tensor(self.move, dtype=torch.float64)
        c2w = torch.cat((torch.linalg.matrix_exp(skew), move[:, None]), dim=1).float()
        return replace(camera, c2w=c2w, fx=self.zoom * camera.fx, fy=self.zoom * camera.fy)

    @property
    def depth(self) -> Tensor:
        """The depth of a wavy wall with an edge and holes."""
        row, column = torch.arange(self.height)[:, None], torch.arange(self.width)
        depth = MIDDLE + 0.005 * torch.sin(0.9 * row + 0.7 * column)
        if self.edge:
            behind = (column >= self.width // 2) | (row == self.height // 3)
            depth = torch.where(behind, depth + self.edge, depth)
        if self.holes:
            missing = (3 * row + column) % 7
            depth = torch.where(missing == 0, torch.inf, depth)
            depth = torch.where((missing == 3) & (row % 4 == 0), torch.nan, depth)
        return depth

    @property
    def cells(self) -> Tensor:
        """The cells that are warped."""
        cells = torch.arange(self.width * self.height)
        return cells[:: self.every] if self.every else cells[:0]


KINDS = {
    "one pixel": Kind(1, 1, 1),
    "one channel": Kind(9, 7, 4, move=(0.02, 0.01, 0.0), channels=1),
    "seven channels": Kind(9, 7, 3, move=(0.02, 0.01, 0.0), channels=7),
    "turned": Kind(24, 17, 4, turn=(0.05, -0.04, 0.02), move=(-0.05, 0.1, 0.05)),
    "rolled": Kind(24, 17, 4, turn=(0.0, 0.0, 0.5 * math.pi)),
    "holes": Kind(24, 17, 4, move=(0.03, 0.0, 0.1), holes=True),
    "edges": Kind(24, 17, 4, move=(0.03, 0.0, 0.1), edge=0.5),
    "edges and holes": Kind(24, 17, 4, edge=0.5, holes=True),
    "leaving the picture": Kind(24, 17, 4, turn=(0.0, 0.2, 0.0), zoom=2.0),
    "behind the source": Kind(24, 17, 4, turn=(0.0, math.pi, 0.0)),
    "partly behind the source": Kind(24, 17, 4, move=(0.0, 0.0, 2.25), edge=2.0),
    "half of it empty": Kind(24, 17, 4, edge=math.inf),
    "no depth": Kind(1, 17, 4, edge=math.inf),
    "some cells": Kind(24, 17, 4, move=(0.03, 0.0, 0.1), every=5),
}

ENLARGED = {
    "one pixel": Kind(1, 1, 4),
    "one of one": Kind(9, 7, 1),
    "three by three": Kind(9, 7, 3),
    "holes": Kind(24, 17, 4, holes=True),
    "edges and holes": Kind(24, 17, 4, edge=0.5, holes=True),
    "half of it empty": Kind(24, 17, 4, edge=math.inf),
    "no depth": Kind(1, 17, 4, edge=math.inf),
    "some cells": Kind(24, 17, 4, every=5),
    "no cell": Kind(24, 17, 4, every=0),
}

TIMED = Kind(LOW, LOW, HIGH // LOW, turn=(0.02, -0.01, 0.0), move=(0.02, 0.0, 0.0), holes=True)

BACK = "x, y and w rounded 6 times at the size of the picture, looked up twice: 24 reach + 8 u"


def cases() -> list[Case]:
    """Warping and enlarging by all backends; views whose pictures are known; a walk."""
    here, origin = CAMERAS["looking at the cube"], CAMERAS["at the origin"]
    found = _agreements()
    for name, camera in CAMERAS.items():
        reach = max(abs(camera.cx), abs(camera.cy), camera.width, camera.height)
        exact = () if camera.c2w[:, 3].any() else ("fp64",)  # where the pose is exact
        tolerances = on_backends(24 * reach + 8, *exact)
        same = Property("warp", "the picture is unchanged", BACK, tolerances)
        for depth in (1e-20, 1.0, 1e20):
            error = partial(_same_error, camera, camera, depth)
            found.append(same.case(f"same pose, {name}, depth {depth:g}", error))
    nothing = Property("warp", "nothing is valid", "comparisons: 0", on_backends(0, "fp64"))
    for name, camera, depth in (
        ("turned by 180 degrees", rotated(here, TURNED), 1.0),
        ("depth inf", here, math.inf),
        ("depth NaN", here, math.nan),
        ("depth 0", here, 0.0),
        ("depth 0, seen from behind", _ahead(here), 0.0),
        ("depth -1, seen from behind", _ahead(here), -1.0),
        ("depth -inf", here, -math.inf),
    ):
        found.append(nothing.case(name, partial(_seen, camera, depth)))
    rolled = Property("warp", "the picture is upside down", BACK, on_backends(24 * 32 + 8))
    known = Property("warp", "what is valid is unchanged", BACK, on_backends(24 * 32 + 8, "fp64"))
    inside = Property(
        "warp",
        "what is valid is what float64 gives",
        "24 reach u as at the same pose, twice with an offset as large as what it is added to, in "
        "a picture that rises by 1 over its width, and looked up: 56 u",
        on_backends(56, "fp64"),
    )
    apart = Property(
        "warp",
        "finite only where a neighbour is, and one of them",
        "depths that far apart do not mix; a mean of one has 8 roundings: 8 u",
        on_backends(8, "fp64"),
    )
    upside_down = partial(_same_error, here, rotated(here, ROLLED), 1.0)
    found += [
        rolled.case("rolled by 180 degrees", upside_down),
        known.case(
            "depth 1e38, of which products are infinite", partial(_known_error, origin, 1e38)
        ),
        inside.case("camera inside the object", _inside_error),
        apart.case("enlarged depth of inf, NaN, 1e20 and 1", _enlarged_error),
    ]
    for frames in (300, 10_000):
        walk = Property(
            "warp",
            "a constant is unchanged, and the rest stays within its range",
            "a look-up has 4 roundings, all of which may point the same way: 4 n u",
            on_backends(4 * frames, "fp64"),
        )
        name = f"{frames:,} frames there and back"
        found.append(walk.case(name, partial(_walk_error, frames), slow=frames > 1000))
    return found


def _agreements() -> list[Case]:
    """Cameras that rest, move, turn and roll; holes, edges; invisible points; a frame."""
    warped = Agreement(
        "warp",
        served(__package__),
        "a place is off by 16 u of the sizes of its sums, in each backend; neighbours differ by at "
        "most 1, so a value by no more than its place along each axis; 8 roundings of its own",
    )
    enlarged = Agreement(
        "warp enlarge",
        served(__package__),
        "a mean of depths has 8 roundings in each backend, at the size of the farthest",
    )
    frame = f"{LOW} x {LOW} to {HIGH} x {HIGH}"
    return [
        *(warped.case(name, *_warping(kind)) for name, kind in KINDS.items()),
        warped.case(frame, *_warping(TIMED), items=HIGH**2),
        *(enlarged.case(name, *_enlarging(kind)) for name, kind in ENLARGED.items()),
        enlarged.case(frame, *_enlarging(TIMED), items=HIGH**2),
    ]


def _warping(kind: Kind) -> tuple[Prepare, float]:
    """What is computed, and its tolerance."""
    shift = _position_error(kind)

    def prepare(device: str) -> Callable[[str], tuple[Tensor, ...]]:
        camera, source, scale = kind.camera, kind.source, kind.scale
        shape = camera.height, camera.width, kind.channels
        picture = torch.rand(shape, generator=torch.Generator().manual_seed(kind.width + scale))
        sure = _sure(kind, shift).to(device)
        picture, depth, cells = (x.to(device) for x in (picture, kind.depth, kind.cells))

        def call(backend: str) -> tuple[Tensor, ...]:
            fine = enlarge(depth, cells, scale, backend=backend)
            values, valid = warp(picture, source, fine, cells, camera, scale, backend=backend)
            return values * sure[..., None], valid * sure

        return call

    return prepare, 2 * shift + 16 * U32


def _enlarging(kind: Kind) -> tuple[Prepare, float]:
    """What is computed, and its tolerance."""
    known = kind.depth[kind.depth.isfinite()]
    farthest = known.max().item() if len(known) else 0.0

    def prepare(device: str) -> Callable[[str], tuple[Tensor, ...]]:
        depth, cells = kind.depth.to(device), kind.cells.to(device)

        def call(backend: str) -> tuple[Tensor, ...]:
            # Missing depth becomes 0, which no depth is, because inf cannot be compared.
            z = enlarge(depth, cells, kind.scale, backend=backend)
            return (z.nan_to_num(nan=-1.0, posinf=0.0),)

        return call

    return prepare, 2 * MEAN_ROUNDINGS * U32 * farthest


def _position_error(kind: Kind) -> float:
    """Bound in pixels on the distance between the positions that two backends look up for a pixel.

    A coordinate is x = n / w. Both are sums of products, with an error of `ROUNDINGS` u times the
    sums of magnitudes n' and w'. So the error of x is `ROUNDINGS` u (n' + |x| w') / w. Bounds are
    taken at the last corner of the picture and the largest depth, except for w, whose minimum over
    all pixels is used.
    """
    source, camera, depth, scale = kind.source, kind.camera, kind.depth, kind.scale
    low = scale_camera(camera, depth.shape[1], depth.shape[0])
    known = depth.flatten().isfinite()
    points = unproject(low, pixel_grid(low.width, low.height)[known], depth.flatten()[known])
    _, ahead = project(source, points)
    ahead = ahead[ahead > 0].double()
    if len(ahead) == 0:
        return 0.0
    matrix, offset = (part.abs() for part in source_from_camera(source, camera))
    farthest = depth[depth.isfinite()].max()
    corner = torch.tensor((camera.width, camera.height, 1.0), dtype=torch.float64)
    across, down, along = farthest * (matrix @ corner) + offset
    worst = torch.maximum(across + source.width * along, down + source.height * along)
    # A pixel takes its depth from centres less than two low-resolution pixels away.
    least = ahead.min() - farthest * 2 * scale * matrix[2, :2].sum()
    return 2 * ROUNDINGS * U32 * (worst / least).item()


def _sure(kind: Kind, margin: float) -> Tensor:
    """Mask [N, s^2] of pixels whose validity stays if the source picture shifts by `margin`."""
    source, cells, scale = kind.source, kind.cells, kind.scale
    picture = torch.ones(source.height, source.width, 1, dtype=torch.float64)
    fine = enlarge(kind.depth.double(), cells, scale, backend="reference")
    valid = []
    for right, down in ((margin, 0.0), (-margin, 0.0), (0.0, margin), (0.0, -margin)):
        moved = replace(source, cx=source.cx + right, cy=source.cy + down)
        given = picture, moved, fine, cells, kind.camera, scale
        valid.append(warp(*given, backend="reference")[1])
    return (torch.stack(valid) == valid[0]).all(dim=0).float()


def _ahead(camera: Camera) -> Camera:
    """The camera moved 3 units along its viewing direction."""
    centre = camera.c2w[:, 3:] + 3 * camera.c2w[:, 2:3]
    return replace(camera, c2w=torch.cat((camera.c2w[:, :3], centre), dim=1))


def _picture(camera: Camera, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return torch.rand(camera.height, camera.width, 3, generator=generator).to(dtype)


def _warped(
    source: Camera, camera: Camera, depth: Tensor, picture: Tensor, backend: str, device: str
) -> tuple[Tensor, Tensor]:
    """Values [H, W, C] and validity [H, W] of the view of `camera`; cells are pixels."""
    cells = torch.arange(depth.numel(), device=device)
    size = camera.height, camera.width
    values, valid = warp(
        picture.to(device), source, depth.view(-1, 1).to(device), cells, camera, 1, backend=backend
    )
    return values.view(*size, -1).cpu(), valid.view(size).cpu()


def _at_depth(
    cameras: tuple[Camera, Camera], depth: float, cell: tuple[str, str], device: str
) -> tuple[Tensor, Tensor, Tensor]:
    """The picture of the first camera, and `_warped` to the second, at constant depth."""
    (source, camera), (backend, precision) = cameras, cell
    picture = _picture(source, DTYPES[precision])
    z = torch.full((camera.height * camera.width,), depth, dtype=picture.dtype)
    return picture, *_warped(source, camera, z, picture, backend, device)


def _same_error(
    source: Camera, camera: Camera, depth: float, backend: str, device: str, precision: str
) -> float:
    picture, values, valid = _at_depth((source, camera), depth, (backend, precision), device)
    want = picture if camera is source else picture.flip(0, 1)
    return (values - want).abs().max().item() if valid.all() else math.inf


def _known_error(camera: Camera, depth: float, backend: str, device: str, precision: str) -> float:
    picture, values, valid = _at_depth((camera, camera), depth, (backend, precision), device)
    return (values - picture * valid[..., None]).abs().max().item()


def _seen(camera: Camera, depth: float, backend: str, device: str, precision: str) -> float:
    """Largest validity and value."""
    cameras = CAMERAS["looking at the cube"], camera
    _, values, valid = _at_depth(cameras, depth, (backend, precision), device)
    return max(values.abs().max().item(), valid.max().item())


def _inside_error(backend: str, device: str, precision: str) -> float:
    """A sideways step of 0.1, surfaces equally near, and a picture that is linear in u and v."""
    camera = CAMERAS["at the origin"]
    c2w = camera.c2w.clone()
    c2w[0, 3] = 0.1
    source, dtype = replace(camera, c2w=c2w), DTYPES[precision]
    pixels = pixel_grid(camera.width, camera.height).double()
    picture = (pixels / 32).view(camera.height, camera.width, 2).to(dtype)
    z = torch.rand(len(pixels), generator=torch.Generator().manual_seed(0)).to(dtype)
    values, valid = _warped(source, camera, z, picture, backend, device)
    if not valid.any():
        return math.inf
    u = pixels[:, 0] - source.fx * source.c2w[0, 3].double() / z.double()
    u = u.clamp(0.5, camera.width - 0.5)  # repeated border
    want = torch.stack((u, pixels[:, 1]), dim=1).view(camera.height, camera.width, 2) / 32
    apart = (values - want).abs().amax(dim=2) * (valid > 0)
    return apart.max().item()


def _enlarged_error(backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    depth = torch.full((5, 5), torch.inf, dtype=dtype)
    depth[1, 1], depth[1, 2], depth[3, 3], depth[4, 0] = 1.0, 1e20, 1e20, torch.nan
    cells = torch.arange(25, device=device)
    got = enlarge(depth.to(device), cells, 4, backend=backend).cpu()
    known = got[got < torch.inf].double()
    if got.isnan().any() or not len(known):
        return math.inf
    return torch.minimum((known - 1).abs(), (known / depth[1, 2].double() - 1).abs()).max().item()


def _walk_error(frames: int, backend: str, device: str, precision: str) -> float:
    """A quarter turn around the scene and back, 50 frames each way, each warped from the last."""
    start = Camera(torch.eye(4)[:3], 8.0, 8.0, 4.0, 4.0, 8, 8)
    up, middle = torch.tensor([0.0, 0.0, 1.0]), torch.full((3,), 0.5)
    first = torch.rand(8, 8, 3, generator=torch.Generator().manual_seed(0)).to(DTYPES[precision])
    first[..., 0] = 0.7
    picture, before, worst = first, None, 0.0
    z = torch.full((64,), 1.5, dtype=first.dtype)
    for frame in range(frames):
        angle = 0.03 * (50 - abs(frame % 100 - 50))
        eye = middle + 1.5 * torch.tensor([math.cos(angle), math.sin(angle), 0.2])
        camera = replace(start, c2w=look_at(eye, middle, up))
        if before is not None:
            values, valid = _warped(before, camera, z, picture, backend, device)
            if not valid.any():
                return math.inf
            picture = torch.where(valid[..., None] > 0, values, first)
        before = camera
        drift = (picture[..., 0] - 0.7).abs().max().item()
        beyond = (picture - 0.5).abs().max().item() - 0.5
        worst = max(worst, drift, beyond) if picture.isfinite().all() else math.inf
    return worst
