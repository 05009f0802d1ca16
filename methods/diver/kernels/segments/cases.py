"""Cases of segments: the weights of corners, also against quadrature; pixels; NaN."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bench.case import (
    U32,
    Bound,
    Cases,
    Given,
    Operation,
    Property,
    Random,
    largest_error,
    on_backends,
    placed,
)
from bench.types import Rays
from methods.diver.kernels.segments import Corners, Layers, render_segments, segment_weights
from methods.kernels.corner_gather import CORNERS, OFFSETS
from methods.kernels.dispatch import served
from methods.kernels.march.cases import some_rays
from methods.kernels.voxel_walk import Crossings, Voxels, walk

FEATURES = HIDDEN = 32
SIDE = 16  # voxels along the grid of the small cases

DENSEST = 1 / 4  # largest density of a segment: sums of 32 products of at most 1 / 128

FARTHEST = 3  # largest depth of a segment

WEIGHTS = (
    "ends of a segment, its middle and its nodes are off by 3 u along each of 3 axes, along which "
    "a weight changes by 1 at most; 3 factors and 2 products of them: 5 u; a mean: 2 u: 16 u"
)
PLACE = (
    "an end is off by its product, its sum, their product with G and the difference: 4 u of at "
    "most 3 G, along each of 3 axes: 36 G u"
)
WEIGH = Operation(
    "segment_weights",
    served(__package__),
    segment_weights,
    {"weights": Bound(f"{WEIGHTS}; {PLACE}; by both: 72 G + 32 u", (72 * SIDE + 32) * U32)},
)


def _light(given: Given) -> float:
    """How far the opacity of a ray may be off: its n segments' densities, rounding; a weight beside
    `stop` or `faint` may count on one side only, and few lie beside a `faint` of 1e-2."""
    longest, faint = 3 * given["corners"].voxels.resolution, given["faint"]
    rounding = longest * (468 * DENSEST + 4) * U32
    return rounding + given["stop"] + (longest * faint if faint < 1e-3 else 2 * faint)


RENDER = Operation(
    "render_segments",
    served(__package__),
    lambda **given: render_segments(**given)[0].columns,
    {
        "values": Bound(
            "as opacities, and colours by 540 / 4 u", lambda given: _light(given) + 540 / 4 * U32
        ),
        "depth sums": Bound(
            "opacities times depths of at most 3", lambda given: FARTHEST * _light(given)
        ),
        "opacities": Bound(
            "weights of the corners are off by 32 u, their sum of 8 by 144 u: 400 u; a layer whose "
            "absolute weights add up to 1 keeps that and adds 34 u, twice; a density has a quarter "
            "of it, and the opacity all of the n densities, 4 n u, stop and n faint",
            _light,
        ),
    },
)


def cases() -> Cases:
    """Segments of every kind; few and many rays, both types of tables, rays that end early, NaN."""
    exact = Property(
        WEIGH.subject,
        "weights are those of a quadrature with four nodes, two more than a cubic needs",
        f"{WEIGHTS}; {PLACE}",
        on_backends(36 * SIDE + 16, "fp64"),
    )
    holds = "a NaN among the features spoils the rays through its voxels alone"
    spoilt = Property(RENDER.subject, holds, "exact", on_backends(0))
    found = [spoilt.case("NaN in a corner", _nan_error)]
    for name, make in {"in a voxel": _inside, "rays through a full grid": _through}.items():
        found += WEIGH.cases(name, make)
        found.append(exact.case(f"{name}, by quadrature", _quadrature_error, make))
    for name, given in {
        "no ray": (SIDE, 0, torch.float32, 0.0, 0.0),
        "one ray": (SIDE, 1, torch.float32, 0.0, 0.0),
        "129 rays": (SIDE, 129, torch.float32, 0.0, 0.0),
        "129 rays, table of bfloat16": (SIDE, 129, torch.bfloat16, 0.0, 0.0),
        "129 rays, stop and faint": (SIDE, 129, torch.float32, 1e-4, 1e-5),
        "8,192 rays in 64^3": (64, 1 << 13, torch.bfloat16, 1e-2, 1e-2),
    }.items():
        found += RENDER.cases(name, scene, *given, items=given[1])
    return found


def _inside() -> Given:
    """Segments in the first voxel: random ones; between corners, middles of edges and faces, and
    the middle, also from one of them to itself."""
    places = torch.cartesian_prod(*[torch.tensor([0.0, 0.5, 1.0])] * 3)
    pairs = torch.cartesian_prod(torch.arange(27), torch.arange(27))
    drawn = Random(1000).share(2, 1000, 3)
    entry, leave = torch.cat((drawn, places[pairs.T]), dim=1)
    count = len(entry)
    ones = torch.ones(count)
    crossings = Crossings(
        t=ones / 2,
        delta=ones,
        offsets=torch.arange(count + 1),
        near=torch.zeros(count),
        far=ones,
        ray=torch.arange(count).int(),
        voxel=torch.zeros(count, dtype=torch.int32),
    )
    return {
        "rays": Rays(entry / SIDE, (leave - entry) / SIDE),
        "crossings": crossings,
        "voxels": Voxels(torch.zeros(1, 3, dtype=torch.int32), SIDE),
    }


def _through() -> Given:
    """Rays through a full grid, and their crossings."""
    ends = Random(5).share(2, 100, 3)
    rays = Rays(2 * ends[0] - ends[1], ends[1] - ends[0])
    voxels = Voxels(torch.cartesian_prod(*[torch.arange(SIDE)] * 3), SIDE)
    crossings = walk(rays, voxels, backend="reference")
    return {"rays": rays, "crossings": crossings, "voxels": voxels}


def _quadrature_error(
    make: Callable[[], Given], backend: str, device: str, precision: str
) -> float:
    rays, crossings, voxels = placed(list(make().values()), device, precision)
    ray = crossings.ray.long()
    corner = voxels.coordinates[crossings.voxel.long()]
    origins = rays.origins[ray].double()
    directions = rays.directions[ray].double()
    near, far = (
        ((origins + t.double()[:, None] * directions) * SIDE - corner).clamp(0, 1)
        for t in (crossings.near, crossings.far)
    )
    exact = torch.zeros(len(ray), CORNERS, dtype=torch.float64, device=device)
    for place, share in zip(*np.polynomial.legendre.leggauss(4), strict=True):
        point = (near + far + place * (far - near))[:, None] / 2  # [S, 1, 3]
        exact += share / 2 * torch.where(OFFSETS.to(device) > 0, point, 1 - point).prod(dim=2)
    return largest_error((segment_weights(rays, crossings, voxels, backend=backend),), (exact,))


def scene(side: int, count: int, dtype: torch.dtype, stop: float, faint: float) -> Given:
    """Every third voxel of a grid, with features from -1 to 1."""
    random = Random(side)

    def between(low: float, high: float, *shape: int) -> Tensor:
        return random.share(*shape) * (high - low) + low

    cells = (random.share(side, side, side) < 1 / 3).nonzero().int()
    rows = (cells[:, None] + OFFSETS) @ torch.tensor([(side + 1) ** 2, side + 1, 1])
    table = between(-1, 1, (side + 1) ** 3, FEATURES).to(dtype)
    layers = Layers(
        between(-1, 1, HIDDEN, FEATURES) / FEATURES,
        between(0, 1, HIDDEN),
        between(0, DENSEST, 1, HIDDEN) / HIDDEN,
        between(0, 0.01, 1),
        between(-1, 1, HIDDEN, HIDDEN) / HIDDEN,
        between(-1, 1, 3, HIDDEN) / HIDDEN,
        between(-1, 1, 3),
    )
    return {
        "rays": some_rays(count),
        "corners": Corners(Voxels(cells, side), rows.int(), table),
        "layers": layers,
        "towards": between(-0.5, 0.5, count, HIDDEN),
        "stop": stop,
        "faint": faint,
    }


def _nan_error(backend: str, device: str, precision: str) -> float:
    """0 if it holds, else infinity."""
    given = placed(scene(SIDE, 129, torch.float32, 0.0, 0.0), device)
    corners = given["corners"]
    whole, _, _ = render_segments(**given, backend=backend)
    row = corners.rows[len(corners.rows) // 2, 0]
    corners.table[row] = math.nan
    spoilt, _, _ = render_segments(**given, backend=backend)
    crossings = walk(given["rays"], corners.voxels, backend="reference")
    touched = torch.zeros(len(whole.alpha), dtype=torch.bool, device=device)
    at_corner = (corners.rows == row).any(dim=1)
    touched[crossings.ray[at_corner[crossings.voxel.long()]].long()] = True
    same = torch.equal(spoilt.values[~touched], whole.values[~touched])
    spoils = torch.equal(spoilt.values.isnan().all(dim=1), touched)
    return 0.0 if same and spoils and touched.any() else math.inf
