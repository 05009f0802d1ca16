"""Gaussians as a PLY file, as the release of Kerbl et al. (2023) writes and most viewers read it.

Coordinates are those of the data set. Properties of a vertex: x y z, nx ny nz (zeros), f_dc_0..2
(the first harmonic), f_rest_* (the others, all of red, then green, then blue), opacity (a logit),
scale_0..2 (logarithms), rot_0..3 (w x y z). The file's harmonics have the Condon-Shortley phase,
ours do not: those of odd order m change sign.

`read` also takes what others write: infinite opacities, opaque or unseen; scales of minus infinity,
or no scale_2 (2DGS), flat; filter_3D (Mip-Splatting).
"""

import math
import re
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from bench.errors import not_there
from bench.kinds import Say
from bench.sharing import whole
from bench.types import Scene, SteerbenchError, TwoTensors
from methods.gaussians.model import Gaussians

POSITION, NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
BASE = tuple(f"f_dc_{i}" for i in range(3))
SCALE = tuple(f"scale_{i}" for i in range(3))
ROTATION = tuple(f"rot_{i}" for i in range(4))

PACKED = (".spz", ".splat", ".ksplat", ".sog", ".lcc")
"""Endings of files that splat-transform of PlayCanvas makes PLY files of."""

MIP = re.compile(r"SplatRenderMode:?\s*mip|\bantialiased\s+1", re.IGNORECASE)
"""How a comment of Brush or Postshot says that the file was trained with antialiasing."""

FAR = 1000  # units of a scene from the origin, float32 leaves 14 bits for a unit

ODD = torch.tensor([(m % 2) == 1 for degree in range(4) for m in range(-degree, degree + 1)])
"""Which harmonics, in our order, have an odd m."""


def write(gaussians: Gaussians, scene: Scene, path: Path) -> None:
    """Write all Gaussians, in the coordinates of the data set of `scene`.

    Positions are doubles where the data set is so far from its origin that float32 would move them.
    """
    view = _flipped(gaussians.view.detach()).transpose(1, 2).flatten(1)
    far = scene.origin.abs().max() > FAR * scene.unit_length
    origin = scene.origin.to(view.device, torch.float64 if far else view.dtype)
    columns: dict[tuple[str, ...], Tensor] = {
        POSITION: origin + scene.unit_length * gaussians.means.detach().to(origin),
        NORMAL: torch.zeros_like(gaussians.means),
        BASE: gaussians.base.detach()[:, 0],
        tuple(f"f_rest_{i}" for i in range(view.shape[1])): view,
        ("opacity",): gaussians.logits.detach()[:, None],
        SCALE: gaussians.log_scales.detach() + math.log(scene.unit_length),
        ROTATION: gaussians.rotations.detach(),
    }
    tables = {group: x.cpu().numpy() for group, x in columns.items()}
    rows = np.empty(len(view), [(n, x.dtype) for group, x in tables.items() for n in group])
    for group, x in tables.items():
        for name, column in zip(group, x.T, strict=True):
            rows[name] = column
    with whole(path) as new:
        PlyData([PlyElement.describe(rows, "vertex")]).write(new)


def read(path: Path, scene: Scene, say: Say) -> Gaussians:
    """Read the Gaussians of a file in the coordinates of the data set of `scene`. Those that cannot
    be drawn are left out; `say` gets a line about these, and about what is not read as it stands.

    SteerbenchError says what is wrong with the file, or that nothing lies inside the scene.
    """

    def refuse(wrong: bool, why: str) -> None:
        if wrong:
            raise SteerbenchError(f"{path}: {why}")

    good = "expected a PLY file of 3D Gaussians"
    if not path.is_file():
        raise not_there(path, "a PLY file of 3D Gaussians")
    convert = f"convert it: splat-transform {path.name} {path.name.partition('.')[0]}-plain.ply"
    kind = path.suffix.lower()
    refuse(kind in PACKED, f"{good}, got {kind}; {convert}")
    try:
        file = PlyData.read(path)
        vertices: np.ndarray = file["vertex"].data
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise SteerbenchError(f"{path}: {good}, could not read one ({error})") from error
    refuse(not len(vertices), "expected 3D Gaussians, it has none")
    names = vertices.dtype.names or ()
    packed = "packed_position" in names
    refuse(packed, f"expected plain 3D Gaussians, got SuperSplat's compressed PLY; {convert}")
    flat = SCALE[1] in names and SCALE[2] not in names
    scale = SCALE[:2] if flat else SCALE
    needed = (*POSITION, *BASE, "opacity", *scale, *ROTATION)
    missing = ", ".join(name for name in needed if name not in names)
    got = f"there is no {missing}, but {', '.join(names[:12])}"
    refuse(bool(missing), f"expected the properties of 3D Gaussians, {got}")
    rest = sorted((n for n in names if re.fullmatch(r"f_rest_\d+", n)), key=lambda n: int(n[7:]))
    degrees = "0, 9, 24 or 45 properties f_rest_* (degrees 0 to 3)"
    refuse(len(rest) not in (0, 9, 24, 45), f"expected {degrees}, got {len(rest)}")

    def columns(*group: str) -> Tensor:
        """[N, len(group)] in the file's own precision."""
        found = np.stack([vertices[name] for name in group], axis=1)
        return torch.from_numpy(found.astype(found.dtype.newbyteorder("=")))

    places, rotations = columns(*POSITION), columns(*ROTATION).float()
    means = ((places - scene.origin.to(places)) / scene.unit_length).float()
    log_scales, logits = columns(*scale).float(), columns("opacity")[:, 0].float()
    harmonics = columns(*BASE, *rest).float()
    if flat:
        log_scales = torch.cat((log_scales, torch.full_like(logits, -math.inf)[:, None]), dim=1)
        say(f"{path}: without scale_2 (2DGS): drawn as flat 3D Gaussians")
    if smooth := [name for name in names if name.lower() == "filter_3d"]:
        logits, log_scales = _fused(logits, log_scales, columns(*smooth).double())
        say(f"{path}: filter_3D is fused into scales and opacities, as Mip-Splatting exports it")
    comments = [*file.comments, *(comment for part in file for comment in part.comments)]
    if any(map(MIP.search, comments)):
        say(f"{path}: trained with antialiasing, as a comment in it says; drawn without")
    known = {*needed, *rest, *smooth, *NORMAL, "vertex"}
    there = *names, *(part.name for part in file)
    if unread := ", ".join(name for name in there if name not in known):
        say(f"{path}: not read: {unread}")

    drawn = torch.cat((means, rotations, harmonics), dim=1).isfinite().all(dim=1)
    drawn &= (rotations != 0).any(dim=1) & (log_scales < math.inf).all(dim=1) & ~logits.isnan()
    of_all = f"of {len(vertices):,} Gaussians"
    if left := int((~drawn).sum()):
        say(f"{path}: {left:,} {of_all} are left out: NaN, infinity or no rotation")
    low, high = scene.bounds
    inside = ((means >= low) & (means <= high)).all(dim=1)[drawn].any()
    elsewhere = "lies inside the scene: expected the coordinates of the data set"
    refuse(not inside, f"none {of_all} {elsewhere}")
    view = harmonics[:, 3:].reshape(len(means), 3, len(rest) // 3).transpose(1, 2)
    log_scales -= math.log(scene.unit_length)
    parts = means, log_scales, rotations, logits, harmonics[:, None, :3], _flipped(view)
    return Gaussians(*(part[drawn].contiguous() for part in parts))


def _fused(logits: Tensor, log_scales: Tensor, width: Tensor) -> TwoTensors:
    """Logits and log scales with the 3D filter of Mip-Splatting (Yu et al. 2024), a Gaussian of
    `width` [N, 1]: variances are added, what is spread is as much fainter."""
    scales = log_scales.double().exp()
    wide = torch.hypot(scales, width)
    opacities = logits.double().sigmoid() * (scales / wide).prod(dim=1)
    return opacities.logit().float(), wide.log().float()


def _flipped(view: Tensor) -> Tensor:
    """Convert harmonics beyond the first [N, C - 1, 3] to or from the other phase."""
    odd = ODD[1 : view.shape[1] + 1].to(view.device)
    return torch.where(odd[:, None], -view, view)
