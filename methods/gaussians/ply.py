"""Gaussians as a PLY file, as the release of Kerbl et al. (2023) writes and most viewers read it.

Coordinates are those of the data set. Properties of a vertex: x y z, nx ny nz (zeros), f_dc_0..2
(the first harmonic), f_rest_* (the others, all of red, then green, then blue), opacity (a logit),
scale_0..2 (logarithms), rot_0..3 (w x y z). The file's harmonics have the Condon-Shortley phase,
ours do not: those of odd order m change sign.
"""

import math
import re
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from bench.sharing import whole
from bench.types import Scene, SteerbenchError
from methods.gaussians.model import Gaussians

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
BASE = tuple(f"f_dc_{i}" for i in range(3))
SCALE = tuple(f"scale_{i}" for i in range(3))
ROTATION = tuple(f"rot_{i}" for i in range(4))
NEEDED = (*POSITION, *BASE, "opacity", *SCALE, *ROTATION)

ODD = torch.tensor([(m % 2) == 1 for degree in range(4) for m in range(-degree, degree + 1)])
"""Which harmonics, in our order, have an odd m."""


def write(gaussians: Gaussians, scene: Scene, path: Path) -> None:
    """Write all Gaussians, in the coordinates of the data set of `scene`."""
    view = _flipped(gaussians.view.detach()).transpose(1, 2).flatten(1)
    columns: dict[tuple[str, ...], Tensor] = {
        POSITION: scene.origin.to(view) + scene.unit_length * gaussians.means.detach(),
        NORMAL: torch.zeros_like(gaussians.means),
        BASE: gaussians.base.detach()[:, 0],
        tuple(f"f_rest_{i}" for i in range(view.shape[1])): view,
        ("opacity",): gaussians.logits.detach()[:, None],
        SCALE: gaussians.log_scales.detach() + math.log(scene.unit_length),
        ROTATION: gaussians.rotations.detach(),
    }
    names = [name for group in columns for name in group]
    table = torch.cat(list(columns.values()), dim=1).cpu().contiguous().numpy()
    rows = table.view([(name, "f4") for name in names])[:, 0]
    with whole(path) as new:
        PlyData([PlyElement.describe(rows, "vertex")]).write(new)


def read(path: Path, scene: Scene) -> Gaussians:
    """Read the Gaussians of a file in the coordinates of the data set of `scene`; SteerbenchError
    says what is wrong with the file or its numbers, or that nothing lies inside the scene."""

    def refuse(wrong: bool, why: str) -> None:
        if wrong:
            raise SteerbenchError(f"{path}: {why}")

    refuse(not path.is_file(), "expected a PLY file of 3D Gaussians, there is none")
    try:
        vertices: np.ndarray = PlyData.read(path, mmap=False)["vertex"].data
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        why = "expected a PLY file of 3D Gaussians, could not read one"
        raise SteerbenchError(f"{path}: {why} ({error})") from error
    refuse(not len(vertices), "expected 3D Gaussians, it has none")
    names = vertices.dtype.names or ()
    missing = ", ".join(name for name in NEEDED if name not in names)
    refuse(bool(missing), f"expected the properties of 3D Gaussians, there is no {missing}")
    rest = sorted((n for n in names if re.fullmatch(r"f_rest_\d+", n)), key=lambda n: int(n[7:]))
    degrees = "0, 9, 24 or 45 properties f_rest_* (degrees 0 to 3)"
    refuse(len(rest) not in (0, 9, 24, 45), f"expected {degrees}, got {len(rest)}")

    def columns(*group: str) -> Tensor:
        return torch.from_numpy(np.stack([vertices[name] for name in group], axis=1)).float()

    of_all = f"of {len(vertices):,} Gaussians"
    bad = int((~columns(*NEEDED, *rest).isfinite()).any(dim=1).sum())
    refuse(bad > 0, f"{bad:,} {of_all} are not finite")
    rotations = columns(*ROTATION)
    bad = int((rotations == 0).all(dim=1).sum())
    refuse(bad > 0, f"{bad:,} {of_all} have a rotation of zeros")
    means = (columns(*POSITION) - scene.origin) / scene.unit_length
    low, high = scene.bounds
    inside = ((means >= low) & (means <= high)).all(dim=1).any()
    elsewhere = "lies inside the scene: expected the coordinates of the data set"
    refuse(not inside, f"none {of_all} {elsewhere}")
    view = columns(*rest).view(-1, 3, len(rest) // 3) if rest else torch.zeros(len(means), 3, 0)
    return Gaussians(
        means,
        columns(*SCALE) - math.log(scene.unit_length),
        rotations,
        columns("opacity")[:, 0],
        columns(*BASE)[:, None],
        _flipped(view.transpose(1, 2).contiguous()),
    )


def _flipped(view: Tensor) -> Tensor:
    """Convert harmonics beyond the first [N, C - 1, 3] to or from the other phase."""
    odd = ODD[1 : view.shape[1] + 1].to(view.device)
    return torch.where(odd[:, None], -view, view)
