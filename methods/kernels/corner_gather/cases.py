"""Cases of the corner features: agreement of backends, integrals in closed form, NaN."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from bench.case import (
    DTYPES,
    U32,
    Agreement,
    Case,
    Prepare,
    Property,
    largest_error,
    on_backends,
)
from bench.types import Rays
from methods.kernels.corner_gather import CORNERS, gather, integral, integral_along, trilinear
from methods.kernels.dispatch import served
from methods.kernels.voxel_walk import Crossings, Voxels, walk

VIEW = 1 << 17
"""Samples of one view, for which the throughput is measured."""

SIDE = 48
"""Voxels along the grid of the cases."""

FINE = 16
"""Voxels along the grid that rays are cast through."""

WEIGHTS = (
    "ends of a segment, its middle and its nodes are off by 3 u along each of 3 axes, along which "
    "a weight changes by 1 at most; 3 factors and 2 products of them: 5 u; a mean: 2 u; 16 u"
)
SUMS = (
    "a number sums gradients of at most 1 over n reads; 2 n independent roundings of partial sums "
    "of at most n add up to 6 sqrt(n) of them but for one case in 10^8 (Higham, Mary 2019)"
)


def cases() -> list[Case]:
    """Few and many samples, wide and narrow tables, segments of every kind, NaN."""
    return [*_weights(), *_gathers(), *_gradients(), *_integrals()]


def _weights() -> list[Case]:
    backends = served(__package__)
    points = Agreement("trilinear", backends, "3 factors and 2 products by both: 2 x 5 u")
    means = Agreement("integral", backends, f"{WEIGHTS} by both")
    found = []
    for count in (0, 1, 257, VIEW):
        items = count if count == VIEW else None
        entry, leave = _segments(count)
        found += [
            points.case(f"{count:,} points", _calls(trilinear, entry), 10 * U32, items=items),
            means.case(
                f"{count:,} segments", _calls(integral, entry, leave), 32 * U32, items=items
            ),
        ]
    return found


def _calls(function: Callable[..., Tensor], *places: Tensor) -> Prepare:
    def prepare(device: str) -> Callable[[str], tuple[Tensor, ...]]:
        placed = [place.to(device) for place in places]
        return lambda backend: (function(*placed, backend=backend),)

    return prepare


def _gathers() -> list[Case]:
    kernel = Agreement(
        "corner_gather",
        served(__package__),
        "8 products of numbers of at most 1, and their sum, by both: 2 x 8 x 9 u",
    )
    found = []
    for count, channels in ((0, 32), (1, 32), (257, 1), (257, 27), (257, 32), (VIEW, 32)):
        for dtype in (torch.float32, torch.bfloat16):
            name = f"{count:,} samples of {channels}"
            name += "" if dtype == torch.float32 else ", table of bfloat16"
            call = partial(_features, count, channels, dtype)
            items = count if count == VIEW else None
            found.append(kernel.case(name, call, 144 * U32, items=items))
    return found


def _gradients() -> list[Case]:
    kernel = Agreement("corner_gather backward", served(__package__), SUMS)
    found = []
    for count, channels in ((0, 32), (1, 32), (257, 27), (VIEW, 32)):
        reads = torch.bincount(_corners()[_voxels(count).long()].flatten().long())
        most = int(reads.max()) if len(reads) else 0
        tolerance = 6 * math.sqrt(most) * (most + 1) * U32
        for buffered in (False, True) if count == 257 else (True,):
            name = f"{count:,} samples of {channels}" + ("" if buffered else ", no buffer")
            call = partial(_gradient, count, channels, buffered)
            items = count if count == VIEW else None
            found.append(kernel.case(name, call, tolerance, items=items))
    return found


def _corners() -> Tensor:
    """Rows of the vertices of a grid of SIDE^3 voxels."""
    voxel = torch.cartesian_prod(*[torch.arange(SIDE)] * 3)
    bits = torch.arange(CORNERS)[:, None] >> torch.arange(3) & 1
    x, y, z = (voxel[:, None] + bits).unbind(dim=-1)
    return ((x * (SIDE + 1) + y) * (SIDE + 1) + z).int()


def _voxels(count: int) -> Tensor:
    """Voxels of samples on neighbouring rays, ray by ray, half a voxel apart."""
    steps = min(count, 2 * SIDE)
    rays = math.ceil(math.sqrt(count / max(steps, 1)))
    across = torch.linspace(0.1, 0.7, rays) * SIDE
    u, v = torch.meshgrid(across, across, indexing="ij")
    t = 0.5 * torch.arange(steps)
    x, y = u[..., None] + 0.2 * t, v[..., None] + 0.1 * t
    place = torch.stack((x, y, t.expand_as(x)), dim=-1).reshape(-1, 3)[:count].long()
    return ((place[:, 0] * SIDE + place[:, 1]) * SIDE + place[:, 2]).int()


def _given(count: int, channels: int, device: str) -> tuple[Tensor, ...]:
    """Table, corners, voxels and weights; no number is larger than 1."""
    generator = torch.Generator().manual_seed(count)
    table = torch.rand((SIDE + 1) ** 3, channels, generator=generator) * 2 - 1
    weights = torch.rand(count, CORNERS, generator=generator)
    return tuple(x.to(device) for x in (table, _corners(), _voxels(count), weights))


def _features(
    count: int, channels: int, dtype: torch.dtype, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    table, *rest = _given(count, channels, device)
    table = table.to(dtype)
    return lambda backend: (gather(table, *rest, backend=backend),)


def _gradient(
    count: int, channels: int, buffered: bool, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    table, *rest = _given(count, channels, device)
    table.requires_grad_()
    generator = torch.Generator().manual_seed(1)
    grad = (torch.rand(count, channels, generator=generator) * 2 - 1).to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        buffer = torch.zeros_like(table) if buffered else None
        features = gather(table, *rest, grad_buffer=buffer, backend=backend)
        if buffer is None:
            return torch.autograd.grad(features, table, grad)
        features.backward(grad)
        return (buffer,)

    return call


def _integrals() -> list[Case]:
    exact = Property(
        "integral",
        "weights are those of the published monomials",
        WEIGHTS,
        on_backends(16, "fp64"),
    )
    parts = Property(
        "integral",
        "the integrals over two parts of a segment add up to that over the whole",
        f"{WEIGHTS}, of parts and whole; a cut is rounded to u: 3 u more: 35 u",
        on_backends(35, "fp64"),
    )
    points = Property(
        "trilinear", "weights at corners are 0 and 1, exactly", "0", on_backends(0, "fp64")
    )
    spoiled = Property(
        "corner_gather",
        "features with a NaN among their weights are NaN; no others change",
        "the same arithmetic for all others: 0",
        on_backends(0),
    )
    along = Property(
        "integral_along",
        "the mean place of the weights is the middle of the crossing",
        "an end is off by its product, its sum, their product with G and the difference: 4 u of at "
        "most 3 G, in both ends; the sum of 8 weights 16 u each: 24 G + 128 u",
        on_backends(24 * FINE + 128),
    )
    ends = torch.tensor(list(itertools.product((0.0, 0.5, 1.0), repeat=3)))
    first, second = (
        x.reshape(-1, 3) for x in (ends[:, None].expand(27, 27, 3), ends.repeat(27, 1))
    )
    kinds = {
        "random segments": _segments(1000),
        "between corners, edges, faces and the middle": (first, second),
        "without length": (ends, ends),
    }
    same = Agreement(
        "integral_along",
        served(__package__),
        "an end is off by 4 u of at most 3 G along each of 3 axes, along which a weight changes by "
        "at most 1; 16 u of its own; by both: 72 G + 32 u",
    )
    return [
        same.case("100 rays through a full grid", _along, (72 * FINE + 32) * U32),
        *(exact.case(name, partial(_moment_error, *ends)) for name, ends in kinds.items()),
        *(parts.case(f"{name}, cut", partial(_cut_error, *ends)) for name, ends in kinds.items()),
        points.case("all corners", _corner_error),
        along.case("rays through a full grid", _way_error),
        spoiled.case("NaN", _spread_of_nan),
    ]


def _segments(count: int) -> tuple[Tensor, Tensor]:
    ends = torch.rand(2, count, 3, generator=torch.Generator().manual_seed(count))
    return ends[0], ends[1]


def _moments(entry: Tensor, leave: Tensor) -> Tensor:
    """Weights [S, 8] from the means of the monomials 1, x, y, xy, ... over a segment, float64."""
    a, b = entry.double(), leave.double()
    means = {0: torch.ones(len(a), dtype=torch.float64)}
    for d in range(3):
        means[1 << d] = (a[:, d] + b[:, d]) / 2
    for d, e in itertools.combinations(range(3), 2):
        same, crossed = a[:, d] * a[:, e] + b[:, d] * b[:, e], a[:, d] * b[:, e] + b[:, d] * a[:, e]
        means[1 << d | 1 << e] = same / 3 + crossed / 6
    means[7] = (a + b).prod(dim=1) / 12 + (a.prod(dim=1) + b.prod(dim=1)) / 6
    weights = [
        sum(
            (-1) ** (monomial ^ corner).bit_count() * means[monomial]
            for monomial in range(CORNERS)
            if monomial & corner == corner
        )
        for corner in range(CORNERS)
    ]
    return torch.stack([torch.as_tensor(weight) for weight in weights], dim=1)


def _moment_error(entry: Tensor, leave: Tensor, backend: str, device: str, precision: str) -> float:
    ends = [x.to(device, DTYPES[precision]) for x in (entry, leave)]
    got = integral(*ends, backend=backend)
    return largest_error((got.cpu(),), (_moments(entry, leave),))


def _cut_error(entry: Tensor, leave: Tensor, backend: str, device: str, precision: str) -> float:
    entry, leave = (x.to(device, DTYPES[precision]) for x in (entry, leave))
    share = 0.3
    cut = entry + share * (leave - entry)
    first, second = (
        integral(a, b, backend=backend).double() for a, b in ((entry, cut), (cut, leave))
    )
    whole = integral(entry, leave, backend=backend)
    return largest_error((whole,), (share * first + (1 - share) * second,))


def _through(device: str) -> tuple[Rays, Crossings, Voxels]:
    """Rays through a full grid, and their crossings."""
    generator = torch.Generator().manual_seed(5)
    ends = torch.rand(2, 100, 3, generator=generator).to(device)
    origins = ends[0] - 1 * (ends[1] - ends[0])
    rays = Rays(origins, ends[1] - origins)
    voxels = Voxels(torch.cartesian_prod(*[torch.arange(FINE, device=device)] * 3), FINE)
    return rays, walk(rays, voxels, backend="reference"), voxels


def _along(device: str) -> Callable[[str], tuple[Tensor, ...]]:
    given = _through(device)
    return lambda backend: (integral_along(*given, backend=backend),)


def _way_error(backend: str, device: str, precision: str) -> float:
    """Distance of the mean position given by the weights from the middle of each crossing."""
    rays, crossings, voxels = _through(device)
    weights = integral_along(rays, crossings, voxels, backend=backend).double()
    bits = torch.arange(CORNERS, device=device)[:, None] >> torch.arange(3, device=device) & 1
    local = (weights[..., None] * bits).sum(dim=1)
    middle = (crossings.near.double() + crossings.far.double()) / 2
    ray, voxel = crossings.ray.long(), crossings.voxel.long()
    place = rays.origins[ray].double() + middle[:, None] * rays.directions[ray].double()
    return largest_error((local,), (place * FINE - voxels.coordinates[voxel],))


def _corner_error(backend: str, device: str, precision: str) -> float:
    bits = torch.arange(CORNERS)[:, None] >> torch.arange(3) & 1
    got = trilinear(bits.to(device, DTYPES[precision]), backend=backend)
    return largest_error((got.cpu(),), (torch.eye(CORNERS),))


def _spread_of_nan(backend: str, device: str, precision: str) -> float:
    """Change of other samples by NaN in every 7th sample; infinite where the NaN is lost."""
    table, corners, voxel, weights = _given(700, 5, device)
    bad = torch.arange(700, device=device) % 7 == 0
    spoiled = weights.clone()
    spoiled[bad, 3] = torch.nan
    got = gather(table, corners, voxel, spoiled, backend=backend)
    if not got[bad].isnan().all():
        return math.inf
    want = gather(table, corners, voxel, weights, backend=backend)
    return largest_error((got[~bad],), (want[~bad],))
