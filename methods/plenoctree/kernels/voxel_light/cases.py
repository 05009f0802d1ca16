"""Cases of voxels with densities and harmonics: pixels, and shaded samples."""

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import U32, Bound, Cases, Given, Operation, Random
from methods.kernels.dispatch import served
from methods.kernels.march.cases import cells, some_rays
from methods.kernels.voxel_walk import Voxels
from methods.plenoctree.kernels.voxel_light import Light, render_voxels, shade_voxels

COLOUR = (16 * 50 * 6 + 16 * 16 * 6) / 4 + 8
"""Error bound in u of a colour: a quarter (slope of the sigmoid) of the error of a sum of 16
products of harmonics (below 2, error 48 u) and numbers below 6, plus the sigmoid's own error."""

FARTHEST = 3  # largest depth of a voxel


def _light(given: Given) -> float:
    """How far the opacity in front of a voxel may be off: rounded once or twice at each of at most
    3 G voxels on both sides; a weight beside `stop` or `faint` may count on one side only."""
    longest = 3 * given["voxels"].resolution
    return 4 * longest * U32 + given["stop"] + longest * given["faint"]


RENDER = Operation(
    "render_voxels",
    served(__package__),
    lambda **given: render_voxels(**given)[0].columns,
    {
        "values": Bound(
            "as opacities, and colours as `COLOUR` says", lambda given: _light(given) + COLOUR * U32
        ),
        "depth sums": Bound(
            "opacities times depths of at most 3", lambda given: FARTHEST * _light(given)
        ),
        "opacities": Bound(
            "light rounded twice by both at each of 3 G voxels: 12 G u; stop; 3 G faint", _light
        ),
    },
)


def _slopes(given: Given) -> Tensor:
    """How far the gradient of a voxel that is seen n times may be off."""
    voxels = len(given["harmonics"])
    n = torch.bincount(given["voxel"].long(), minlength=voxels).double()[:, None, None]
    return n * (2 * (COLOUR + 4) + 12 + n / 2) * U32


SHADE = Operation(
    "shade_voxels",
    served(__package__),
    shade_voxels,
    {
        "colours": Bound(
            "the sum of `shade`, of which the sigmoid passes on a quarter, and 8 u of its own",
            COLOUR * U32,
        )
    },
    {
        "harmonics": Bound(
            "n visits of a voxel: each a harmonic below 2, off by 48 u, times a slope of at most "
            "1 / 4, off as colours are and by 4 u; n sums of at most n / 2: n (2 (COLOUR + 4) + "
            "12 + n / 2) u",
            _slopes,
        )
    },
)


def cases() -> Cases:
    """Rays of every kind of light; no, one and many samples of all degrees."""
    found = []
    scenes: dict[str, tuple[Any, ...]] = {
        "one ray": (24, 1, 20.0),
        "no ray": (24, 0, 20.0),
        "cloud": (24, 129, 20.0),
        "mist": (24, 129, 2.0),
        "stone": (24, 129, 1e4),
        "voxels without density": (24, 129, 0.0),
        "no voxel": (24, 129, None),
        "stop and faint": (24, 129, 20.0, 1e-4, 1e-5),
        "a frame of 128^3": (128, 1 << 13, 20.0, 1e-4, 1e-5),
    }
    for name, given in scenes.items():
        found += RENDER.cases(name, _scene, *given, items=given[1])
    for count in (0, 1, 300, 1 << 16):
        for size in (1, 4, 9, 16) if count == 300 else (9,):
            name = f"{count:,} of {size} harmonics"
            found += SHADE.cases(name, _samples, count, size, items=count)
    return found


def _scene(
    size: int, rays: int, densest: float | None, stop: float = 0.0, faint: float = 0.0
) -> Given:
    """Voxels in a thick shell, every second one, of random density and light; or none at all."""
    coordinates = cells("empty" if densest is None else "porous shell", size).nonzero()
    random = Random(size)
    density = (densest or 0.0) * random.share(len(coordinates))
    harmonics = random.normal(len(coordinates), 9, 3).clamp(-6, 6)
    light, voxels = Light(density, harmonics), Voxels(coordinates, size)
    return {"rays": some_rays(rays), "voxels": voxels, "light": light, "stop": stop, "faint": faint}


def _samples(count: int, size: int) -> Given:
    """Harmonics below 6, three samples of a voxel and five of a ray on average."""
    random, voxels, rays = Random(count), count // 3 + 1, count // 5 + 1
    return {
        "harmonics": random.normal(voxels, size, 3).clamp(-6, 6),
        "voxel": random.whole(0, voxels, count).int(),
        "ray": random.whole(0, rays, count).sort().values.int(),
        "directions": normalize(random.normal(rays, 3), dim=1),
    }
