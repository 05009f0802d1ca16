"""Cases of the splatting: agreement of the backends, frames into themselves, borders, ties.

Only comparisons decide which point is shown, so the tolerance is 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from bench.cameras import pixel_grid, project, unproject
from bench.case import DTYPES, U32, Agreement, Case, Property, on_backends
from bench.cases import CAMERAS, moved_by, random_motion
from bench.types import Camera
from methods.kernels.dispatch import served
from methods.steernerf.kernels.splat import Rule, gather, splat

LOW, HIGH = 200, 800
"""Sides in pixels of the splatted frame and of the target picture."""

FRAME = f"{LOW} x {LOW} into {HIGH} x {HIGH}"

CHANNELS = 6
"""Features of a point in SteerNeRF: a colour and three others."""

WRONG = (math.nan, math.inf, -math.inf, 1e20, -1e20, 0.0, -0.0, 1e-20, -1e-20)
"""Coordinates and depths that are outside every picture, or barely inside."""

WIDTH, HEIGHT = 7, 5

TURNED = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
ROLLED = torch.diag(torch.tensor([-1.0, -1.0, 1.0]))

NUMBERS = (-math.inf, -1.0, -1e-20, 0.0, 1e-20, 0.5, 1.0, 1e20, math.inf, math.nan)

Points = Callable[[], tuple[Tensor, Tensor]]
"""Makes pixels [N, 2] and depths [N]."""


def cases() -> list[Case]:
    """Splatting and gathering by all backends; frames and points whose pixels are known."""
    return [*_splats(), *_gathers(), *_known_pixels()]


def _splats() -> list[Case]:
    """No, one, many and crowded points; ties; points outside; thin pictures; a frame, timed."""
    sizes: list[tuple[str, int, int, int, dict[str, bool]]] = [
        ("no point", 0, 5, 4, {}),
        ("one pixel", 50, 1, 1, {}),
        ("sparse", 100, 67, 45, {}),
        ("crowded", 3000, 13, 7, {}),
        ("ties", 3000, 13, 7, {"tied": True}),
        ("outside or not finite", 1000, 40, 30, {"spoiled": True}),
        ("one wide row", 5000, 4097, 1, {}),
        ("three wide rows", 5000, 4097, 3, {}),
    ]
    rules: tuple[tuple[str, Rule], ...] = (("splat", "nearest"), ("splat last", "last"))
    found = []
    for subject, rule in rules:
        kernel = Agreement(subject, served(__package__), "decided by comparisons: 0")
        for name, count, width, height, options in sizes:
            points = partial(_points, count, width, height, **options)
            found.append(kernel.case(name, partial(_splat, points, (width, height), rule), 0.0))
        timed = partial(_splat, _seen_aside, (HIGH, HIGH), rule)
        found.append(kernel.case(FRAME, timed, 0.0, items=LOW**2))
    return found


def _gathers() -> list[Case]:
    """No pixel; no channel; points shown by no, one and many pixels; a frame, timed."""
    kinds = [
        ("no point", _index(0, 20), 0, CHANNELS),
        ("no pixel", _index(10, 0), 10, CHANNELS),
        ("no channel", _index(10, 20), 10, 0),
        ("one channel", _index(300, 1001), 300, 1),
        ("few places for each point", _index(1000, 1001), 1000, CHANNELS),
        ("many places for each point", _index(3, 1001), 3, CHANNELS),
        (FRAME, splat(*_seen_aside(), HIGH, HIGH, backend="reference"), LOW**2, CHANNELS),
    ]
    backends = served(__package__)
    forward = Agreement("splat gather", backends, "nothing is computed: 0")
    backward = Agreement(
        "splat gather backward",
        backends,
        "of n places, n - 1 sums of at most n, off by n u in each backend: 2 n (n - 1) u",
    )
    found = []
    for name, index, points, channels in kinds:
        places = int(torch.bincount(index[index >= 0], minlength=1).max())
        tolerance, items = 2 * max(places - 1, 0) * places * U32, None
        if name == FRAME:
            items = HIGH**2
        inputs = index, points, channels
        found += [
            forward.case(name, partial(_gather, *inputs), 0.0, items=items),
            backward.case(name, partial(_gather_backward, *inputs), tolerance, items=items),
        ]
    return found


def _known_pixels() -> list[Case]:
    """Frames with known pixels, and points with extreme positions.

    Frames are seen by their own camera, by a turned and a rolled one, and after a rigid motion.
    Points lie at borders, in ties, or have extreme depths and coordinates.
    """
    here = CAMERAS["looking at the cube"]
    turned, rolled = rotated(here, TURNED), rotated(here, ROLLED)
    derivation = "decided by comparisons, half a pixel from where they turn: 0 wrong"
    itself, nothing, opposite, loop = (
        Property("splat", holds, derivation, on_backends(0, "fp64"))
        for holds in (
            "every pixel shows itself",
            "nothing is seen",
            "every pixel is opposite",
            "each pixel as of a loop",
        )
    )
    away = partial(_frame_error, here, turned, lambda own: -torch.ones_like(own))
    upside_down = partial(_frame_error, here, rolled, lambda own: own.flip(0, 1))
    found = [
        nothing.case("turned by 180 degrees", away),
        opposite.case("rolled by 180 degrees", upside_down),
        itself.case("rigid motion of scene and cameras", partial(_moved_frame_error, 0)),
    ]
    for name, camera in CAMERAS.items():
        error = partial(_frame_error, camera, camera, lambda own: own)
        found.append(itself.case(f"same pose, {name}", error))
    for name, points in (
        ("borders, to the last bit", _borders),
        ("depth 0, negative, 1e-20, 1e20, inf, NaN", _depths),
        ("places inf and NaN", _places),
        ("ties in depth, in u, in all", _ties),
    ):
        found += [
            loop.case(f"{name}, {rule}", partial(_points_error, points, rule))
            for rule in ("nearest", "last")
        ]
    return found


def _points(
    count: int, width: int, height: int, *, tied: bool = False, spoiled: bool = False
) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(count + width)
    pixels = torch.rand(count, 2, generator=generator) * torch.tensor([width, height])
    depth = 1 + torch.rand(count, generator=generator)
    if tied:  # by depth, by u and v, and exact duplicates
        pixels, depth = (4 * pixels).round() / 4, depth.round()
    if spoiled:
        pixels = 1.5 * pixels - 0.25 * torch.tensor([width, height])
        for values in (pixels, depth):
            drawn = torch.randint(len(WRONG), values.shape, generator=generator)
            spoil = torch.rand(values.shape, generator=generator) < 0.1
            values[spoil] = torch.tensor(WRONG)[drawn][spoil]
    return pixels, depth


def _seen_aside() -> tuple[Tensor, Tensor]:
    """A frame seen from slightly beside: its pixels scatter by half a pixel of the picture."""
    generator = torch.Generator().manual_seed(0)
    pixels = HIGH / LOW * pixel_grid(LOW, LOW) + torch.tensor([5.0, -3.0])
    pixels += 0.5 * torch.randn(LOW**2, 2, generator=generator)
    return pixels, 1 + torch.rand(LOW**2, generator=generator)


def _index(points: int, pixels: int) -> Tensor:
    generator = torch.Generator().manual_seed(points + pixels)
    return torch.randint(-1, points, (pixels,), generator=generator, dtype=torch.int32)


def _splat(
    points: Points, size: tuple[int, int], rule: Rule, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    pixels, depth = (tensor.to(device) for tensor in points())

    return lambda backend: (splat(pixels, depth, *size, rule=rule, backend=backend),)


def _rows(points: int, channels: int, device: str) -> Tensor:
    generator = torch.Generator().manual_seed(points)
    return torch.rand(points, channels, generator=generator).to(device)


def _gather(
    index: Tensor, points: int, channels: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    index, values = index.to(device), _rows(points, channels, device)
    return lambda backend: (gather(values, index, backend=backend),)


def _gather_backward(
    index: Tensor, points: int, channels: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    index, values = index.to(device), _rows(points, channels, device).requires_grad_()
    grad = torch.rand(*index.shape, channels, generator=torch.Generator().manual_seed(1)).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        return torch.autograd.grad(gather(values, index, backend=backend), values, grad)

    return call


def rotated(camera: Camera, rotation: Tensor) -> Camera:
    """The camera turned about its own axes."""
    c2w = torch.cat((camera.c2w[:, :3] @ rotation, camera.c2w[:, 3:]), dim=1)
    return replace(camera, c2w=c2w)


def _frame(camera: Camera, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """The pixels of a frame with random depth, as points, and their indices as a picture."""
    pixels = pixel_grid(camera.width, camera.height).to(dtype)
    depth = 10 ** torch.empty(len(pixels)).uniform_(
        -1, 3, generator=torch.Generator().manual_seed(0)
    ).to(dtype)
    own = torch.arange(len(pixels)).view(camera.height, camera.width)
    return unproject(camera, pixels, depth), own


def _wrong(points: Tensor, camera: Camera, want: Tensor, backend: str, device: str) -> float:
    pixels, depth = project(replace(camera, c2w=camera.c2w.to(device)), points.to(device))
    index = splat(pixels, depth, camera.width, camera.height, backend=backend)
    return float((index.cpu() != want).sum())


def _frame_error(
    source: Camera,
    camera: Camera,
    expected: Callable[[Tensor], Tensor],
    backend: str,
    device: str,
    precision: str,
) -> float:
    """How many pixels show another point than expected."""
    points, own = _frame(source, DTYPES[precision])
    return _wrong(points, camera, expected(own), backend, device)


def _moved_frame_error(seed: int, backend: str, device: str, precision: str) -> float:
    rotation, translation = random_motion(seed)
    camera, dtype = CAMERAS["looking at the cube"], DTYPES[precision]
    points, own = _frame(camera, dtype)
    moved = (points.double() @ rotation.T + translation).to(dtype)
    return _wrong(moved, moved_by(camera, rotation, translation), own, backend, device)


def _borders() -> tuple[Tensor, Tensor]:
    """Points on each border of the picture, and at the floats just before and after it."""
    edges = []
    for edge in (0.0, 1.0, WIDTH - 1.0, WIDTH, HEIGHT - 1.0, HEIGHT):
        at = torch.tensor(edge)
        edges += [at.nextafter(torch.tensor(-math.inf)), at, at.nextafter(torch.tensor(math.inf))]
    places = torch.stack(edges)
    return torch.cartesian_prod(places, places), torch.ones(len(places) ** 2)


def _depths() -> tuple[Tensor, Tensor]:
    depth = torch.tensor(NUMBERS)
    return torch.full((len(depth), 2), 2.5), depth


def _places() -> tuple[Tensor, Tensor]:
    places = torch.cartesian_prod(torch.tensor(NUMBERS), torch.tensor(NUMBERS))
    return places, torch.ones(len(places))


def _ties() -> tuple[Tensor, Tensor]:
    """Tied points, all in one pixel or the next."""
    u, v = torch.tensor([2.25, 2.5, 3.0]), torch.tensor([1.0, 1.5])
    corners = torch.cartesian_prod(u, v, torch.tensor([1.0, 1.0 + 2**-23]))
    points = torch.cat((corners, corners.flip(0), corners))
    return points[:, :2], points[:, 2]


def _points_error(make: Points, rule: str, backend: str, device: str, precision: str) -> float:
    """How many pixels show another point than a plain loop over all points."""
    pixels, depth = (x.to(DTYPES[precision]) for x in make())
    shown: dict[tuple[int, int], int] = {}
    for point, ((u, v), z) in enumerate(zip(pixels.tolist(), depth.tolist(), strict=True)):
        if 0 <= u < WIDTH and 0 <= v < HEIGHT and 0 < z < math.inf:
            cell = int(v), int(u)
            before = shown.get(cell)
            hidden = before is not None and rule == "nearest"
            if not hidden or (z, u, v) < (depth[before].item(), *pixels[before].tolist()):
                shown[cell] = point
    want = torch.full((HEIGHT, WIDTH), -1)
    for cell, point in shown.items():
        want[cell] = point
    pixels, depth = pixels.to(device), depth.to(device)
    got = splat(pixels, depth, WIDTH, HEIGHT, rule=rule, backend=backend)  # type: ignore[arg-type]
    return float((got.cpu() != want).sum())
