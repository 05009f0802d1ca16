"""Makes a Scene from described views, the last step of every loader; holds pictures out of it.

The part of a data set's space that is rendered, a `Box`, fills the unit cube. Where all of space
is rendered, the box has most detail, and fills the middle half of the cube along each axis.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bench.cameras import move_camera, project
from bench.errors import unexpected
from bench.scenes.files import whole_number
from bench.scenes.images import Pictures, View, describe
from bench.scenes.masks import Masks
from bench.scenes.remarks import Remarks
from bench.threads import in_parallel, torch_threads
from bench.types import BACKGROUNDS, Camera, Cameras, Log, Scene, SomeTensors, Split

MARGIN = 0.05  # enlarges the box of a hull by this share of its longest side, half at each end

SPACES = ("auto", "box", "all")
PLAIN, JPEG_NOISE = 0.9, 8  # share of a border that is plain, of 255 levels
PULL = 1e-3  # of the centres of cameras on the point that they look at, of that of their axes

CELLS = 64  # along each side of the cube that is searched for the visual hull
HALVINGS = 8  # of a box that may be much larger than what it holds
BLOCK, GLANCES = 4, 16
"""Before single cells, blocks of BLOCK^3 cells are tested against the first GLANCES pictures: a
dropped block drops all its cells."""


def describe_splits(
    views: Mapping[str, Sequence[View]], downscale: int, log: Log
) -> dict[str, Pictures]:
    """The pictures of every split, each file read once; pixels are decoded on demand."""
    whole_number(downscale, "downscale", 1)
    every = [view for split in views.values() for view in split]
    if masked := sum(view.mask is not None for view in every):
        unused = "is not learnt from, nor scored unless protocol.mask=none"
        log.info(f"{masked} of {len(every)} pictures have masks: what they hide {unused}")
    train, test = ({view.path for view in views.get(part, ())} for part in ("train", "test"))
    if both := sorted(train & test):
        log.info(f"in train and test: {len(both)} pictures, {both[0]} is the first")
    described = in_parallel(lambda view: describe(view, downscale), every, "read pictures", log)
    for turned, how in ((True, "turned"), (False, "not turned, as their cameras are")):
        if names := [of.view.name for of in described if of.turned is turned]:
            log.info(f"EXIF orientation: {len(names)} pictures are {how}, {names[0]} is the first")
    remarks, rest = Remarks(), iter(described)
    remarks.add_doubts(described)
    remarks.tell(log.info)
    return {name: Pictures([next(rest) for _ in split], log) for name, split in views.items()}


def assemble(
    name: str,
    pictures: Mapping[str, Pictures],
    box: Box,
    *,
    background: str,
    camera_files: Iterable[Path],
    space: str = "box",
) -> Scene:
    """The scene, scaled so that `box` fills the unit cube, or the middle of all `space`.

    The digest covers the bytes of `camera_files` and of all picture files, the background, the
    resolution, the box and the space. Raises SteerbenchError if the box, or a camera in its units,
    exceeds the range of float32.
    """
    if background not in BACKGROUNDS:
        raise unexpected("background", " or ".join(BACKGROUNDS), repr(background))
    _check_float32("bounds", [box.side], box.origin.tolist())
    corners = box.lower.tolist(), box.upper.tolist()
    named = (background, corners) if space == "box" else (background, corners, space)
    digest = hashlib.sha256(repr(named).encode())
    files = list(camera_files)
    for path in files:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    outer = box if space == "box" else box.middle_of()
    splits = {}
    for split, of_split in pictures.items():
        cameras, names = [], []
        for picture in of_split.described:
            camera = move_camera(picture.camera, 1 / outer.side, -outer.origin / outer.side)
            others = [camera.cx, camera.cy, *camera.c2w.flatten().tolist()]
            _check_float32(picture.view.name, [camera.fx, camera.fy], others)
            digest.update(f"{split} {camera.width} {camera.height} {picture.sha256}".encode())
            files.append(picture.view.path)
            if picture.mask:
                digest.update(picture.mask.sha256.encode())
                files.append(picture.mask.view.path)
            cameras.append(camera)
            names.append(picture.view.name)
        masked = any(picture.mask for picture in of_split.described)
        masks = Masks(of_split.described, of_split.log) if masked else ()
        splits[split] = Split(cameras, of_split, names, masks)
    return Scene(
        name=name,
        splits=splits,
        background=torch.full((3,), BACKGROUNDS[background]),
        bounds=outer.place_of(box),
        unit_length=outer.side,
        digest=digest.hexdigest(),
        origin=outer.origin,
        space=space,
        files=tuple(files),
    )


def _check_float32(where: str, lengths: Sequence[float], others: Sequence[float]) -> None:
    """Raise unless all numbers fit into float32 and `lengths` stay positive in it."""
    low, high = torch.finfo(torch.float32).tiny, torch.finfo(torch.float32).max
    if not all(low <= x <= high for x in lengths) or not all(abs(x) <= high for x in others):
        expected = f"lengths of {low:.0e} to {high:.0e} once the box is the unit cube"
        got = f"{[*lengths, *others]}: look at the poses and the bounds"
        raise unexpected(where, expected, got)


def hold_out(scene: Scene, split: str, every: int) -> Scene:
    """Move the middle one of every `every` training pictures to a split called `split`.

    In a capture along a path, held-out pictures so lie between training pictures. An existing split
    of that name is replaced. The digest changes, as trainings without these pictures differ.

    Raises SteerbenchError if there are fewer than `every` training pictures.
    """
    train = scene.splits["train"]
    if len(train) < every:
        expected = f"at least {every} training pictures, of which one in {every} is held out"
        raise unexpected(f"split={split}", expected, f"{len(train)} of {scene.name}")
    held = range(every // 2, len(train), every)
    kept = [index for index in range(len(train)) if index not in held]
    splits = {**scene.splits, "train": _taken(train, kept), split: _taken(train, held)}
    digest = hashlib.sha256(f"{scene.digest}, {split}: {list(held)}".encode()).hexdigest()
    return replace(scene, splits=splits, digest=digest)


def _taken(split: Split, indices: Sequence[int]) -> Split:
    images = list(split.images)  # decode all in parallel, which is faster than one by one
    return Split(
        [split.cameras[index] for index in indices],
        [images[index] for index in indices],
        [split.names[index] for index in indices],
        [split.mask(index) for index in indices] if split.masks else (),
    )


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the data set's units: `lower` and `upper` corner, [3] float64."""

    lower: Tensor
    upper: Tensor

    @property
    def side(self) -> float:
        """The longest side: the length of one scene unit."""
        return (self.upper - self.lower).max().item()

    @property
    def origin(self) -> Tensor:
        """The data set's coordinates of the corner (0, 0, 0) of the unit cube, [3] float64."""
        return (self.lower + self.upper) / 2 - self.side / 2

    def place_of(self, other: Box) -> Tensor:
        """[2, 3] float32 corners of `other` once this box is centred in the unit cube."""
        corners = torch.stack((other.lower, other.upper))
        return ((corners - self.origin) / self.side).float().clamp(0, 1)

    def middle_of(self) -> Box:
        """The cube whose middle half along each axis is the cube around this box."""
        middle = (self.lower + self.upper) / 2
        return Box(middle - self.side, middle + self.side)

    def grown(self, share: float = MARGIN) -> Box:
        """The box, longer along every axis by `share` of its longest side."""
        return Box(self.lower - share * self.side / 2, self.upper + share * self.side / 2)


def space_of(space: str, pictures: Mapping[str, Pictures], background: str) -> str:
    """What `scene.space` stands for, "box" or "all": "auto" is all of space if the training
    pictures have a background: they are neither transparent anywhere nor of the scene's
    `background` all along their border, as pictures of objects are."""
    if space not in SPACES:
        raise unexpected("scene.space", " or ".join(SPACES), repr(space))
    if space != "auto":
        return space
    train = pictures["train"]
    clear = (train[n] for n, picture in enumerate(train.described) if picture.clear)
    if any((picture[..., 3] < 255).any() for picture in clear):
        return "box"
    level = 255 * BACKGROUNDS.get(background, 0)
    some = train[:: -(-len(train) // GLANCES)]
    return "box" if all(_border_share(picture, level) > PLAIN for picture in some) else "all"


def _border_share(picture: Tensor, level: float) -> float:
    """The share of the pixels at the border of a picture [H, W, 3] whose channels are all about at
    `level` of 255: not as far off as a JPEG file may be."""
    sides = picture[0], picture[-1], picture[:, 0], picture[:, -1]
    off = (torch.cat(sides)[:, :3].float() - level).abs().amax(dim=1)
    return (off <= JPEG_NOISE).float().mean().item()


def box_of_cameras(cameras: Cameras) -> Box:
    """The cube around the point that cameras look at, with all of them inside or on a face.

    The point is the nearest to their optical axes, and a little to their centres, so that there is
    one if they are parallel."""
    poses = torch.stack([camera.c2w.double() for camera in cameras])
    ahead, centres = poses[:, :, 2], poses[:, :, 3]
    across = torch.eye(3).double() - ahead[:, :, None] * ahead[:, None] + PULL * torch.eye(3)
    sums = (across @ centres[:, :, None]).sum(dim=0).squeeze(1)
    middle = torch.linalg.solve(across.sum(dim=0), sums)
    half = (centres - middle).abs().max()
    half = half if half > 1e-9 * (1 + middle.abs().max()) else torch.ones_like(half)
    return Box(middle - half, middle + half)


def cube(half: float) -> Box:
    return Box(torch.full((3,), -half).double(), torch.full((3,), half).double())


def parse_box(value: object) -> Box:
    """A box from a user's [[x0, y0, z0], [x1, y1, z1]]."""
    with suppress(TypeError, ValueError, OverflowError):
        corners = torch.tensor(value, dtype=torch.float64)
        if corners.shape == (2, 3) and corners.isfinite().all() and (corners[0] < corners[1]).all():
            return Box(*corners)
    expected = "auto, full or a lower and an upper corner [x, y, z]"
    raise unexpected("bounds", expected, repr(value))


@torch_threads(1)
def hull_box(cameras: Cameras, images: SomeTensors, space: Box) -> Box | None:
    """The box of the visual hull of the pictures' masks (alpha > 0) inside `space`.

    A cell is dropped only if its whole projection, plus one pixel around it, lies inside a picture
    and shows nothing. None if the pictures are opaque or no cell is left.
    """
    if any(image.shape[2] < 4 for image in images) or all((x[..., 3] == 255).all() for x in images):
        return None
    size = (space.upper - space.lower) / CELLS
    views = list(zip(cameras, images, strict=True))
    blocks = _left(_grid(CELLS // BLOCK), views[:GLANCES], space.lower, size * BLOCK)
    cells = (blocks[:, None] * BLOCK + _grid(BLOCK)).flatten(0, 1)
    cells = _left(cells, views, space.lower, size)
    if not len(cells):
        return None
    lower = space.lower + size * cells.amin(0)
    upper = space.lower + size * (cells.amax(0) + 1)
    return Box(lower, upper).grown()


def tight(space: Box, train: Pictures) -> Box:
    """The box of the visual hull of the training masks, searched for in the middle of `space`: in a
    part that is halved as long as it holds the whole hull. `space` itself without one."""
    cameras = [picture.camera for picture in train.described]
    found, part, middle = space, space, (space.lower + space.upper) / 2
    for _ in range(HALVINGS):
        hull = hull_box(cameras, train, part)
        if hull and (hull.lower > part.lower).all() and (hull.upper < part.upper).all():
            found = hull
        elif found is not space:
            break
        part = Box((part.lower + middle) / 2, (part.upper + middle) / 2)
    return found


def _grid(side: int) -> Tensor:
    """The integer positions [side^3, 3] of a cube of cells."""
    return torch.cartesian_prod(*(torch.arange(side, dtype=torch.float32),) * 3)


def _left(
    cells: Tensor, views: Sequence[tuple[Camera, Tensor]], lower: Tensor, size: Tensor
) -> Tensor:
    """The `cells` [M, 3] of `size` [3], counted from `lower` [3], that no picture drops."""
    for camera, image in views:
        corners = (lower + size * (cells[:, None] + _grid(2))).float()  # [M, 8, 3]
        pixels, depth = project(camera, corners)
        first = pixels.amin(1).floor() - 1
        last = pixels.amax(1).floor() + 2  # one past the last pixel
        limit = first.new_tensor(camera.size)
        inside = ((first >= 0) & (last <= limit)).all(1) & (depth > 0).all(1)
        (u0, v0), (u1, v1) = (edge[inside].long().unbind(1) for edge in (first, last))
        # A summed-area table counts the mask's pixels in any rectangle with four look-ups. NumPy's
        # 32-bit cumsum takes a quarter of the time of torch's, which is 64-bit.
        mask = (image[..., 3] > 0).numpy()
        sums = mask.cumsum(0, dtype=np.int32).cumsum(1, dtype=np.int32)
        table = torch.from_numpy(np.pad(sums, ((1, 0), (1, 0))))
        count = table[v1, u1] - table[v0, u1] - table[v1, u0] + table[v0, u0]
        seen = torch.ones(len(cells), dtype=torch.bool)
        seen[inside] = count > 0
        cells = cells[seen]
    return cells
