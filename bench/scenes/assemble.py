"""Makes a Scene from described views: the last step of every loader."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import torch

from bench.cameras import move_camera
from bench.scenes.bounds import Box
from bench.scenes.files import unexpected, whole_number
from bench.scenes.images import Pictures, View, describe_all
from bench.types import BACKGROUNDS, Log, Scene, Split, SteerbenchError

SMALLEST, LARGEST = torch.finfo(torch.float32).tiny, torch.finfo(torch.float32).max
"""Range of lengths that float32 holds at full precision."""


def every_nth(views: Sequence[View], step: int, where: Path) -> dict[str, list[View]]:
    """Split views, sorted by name: 0, step, 2 * step ... are the test split, the others train.

    Raises:
        SteerbenchError, which names `where`: `step` is less than 2, or nothing is left to train on.
    """
    whole_number(step, "split_every", 2)
    views = sorted(views, key=lambda view: view.name)
    if len(views) < 2:
        got = f"{len(views)} pictures, each of which split_every={step} makes a test"
        raise unexpected(where, "a picture to train on", got)
    return {"train": [v for i, v in enumerate(views) if i % step], "test": views[::step]}


def leave_out(missing: Sequence[str], views: Sequence[View], where: str, log: Log) -> None:
    """Log the names of `missing` pictures; the scene is made from the other `views`.

    Raises:
        SteerbenchError: there are no other views.
    """
    if not views:
        raise unexpected(where, "pictures", f"none of {len(missing)} files is there")
    if missing:
        count = f"{len(missing)} of {len(views) + len(missing)}"
        log.info(f"{where}: {count} pictures are not there, left out: {', '.join(missing)}")


def describe_splits(
    views: Mapping[str, Sequence[View]], downscale: int, log: Log
) -> dict[str, Pictures]:
    """The pictures of every split, each file read once; pixels are decoded on demand."""
    whole_number(downscale, "downscale", 1)
    found = iter(describe_all([view for split in views.values() for view in split], downscale, log))
    return {name: Pictures([next(found) for _ in split], log) for name, split in views.items()}


def assemble(
    name: str,
    pictures: Mapping[str, Pictures],
    box: Box,
    *,
    background: str,
    camera_files: Iterable[Path],
) -> Scene:
    """The scene, scaled so that `box` fills the unit cube.

    The digest covers the bytes of `camera_files` and of all picture files, the background, the
    resolution and the box.
    Raises SteerbenchError if the box, or a camera in its units, exceeds the range of float32.
    """
    if background not in BACKGROUNDS:
        names = " or ".join(BACKGROUNDS)
        raise SteerbenchError(f"background: expected {names}, got {background!r}")
    _check_float32("bounds", [box.side], box.origin.tolist())
    splits = {
        split: Split(
            cameras=[
                move_camera(picture.camera, 1 / box.side, -box.origin / box.side)
                for picture in of_split.described
            ],
            images=of_split,
            names=[picture.view.name for picture in of_split.described],
        )
        for split, of_split in pictures.items()
    }
    for part in splits.values():
        for view, camera in zip(part.names, part.cameras, strict=True):
            others = [camera.cx, camera.cy, *camera.c2w.flatten().tolist()]
            _check_float32(view, [camera.fx, camera.fy], others)
    corners = box.lower.tolist(), box.upper.tolist()
    digest = hashlib.sha256(repr((background, corners)).encode())
    for path in camera_files:
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    for split, of_split in pictures.items():
        for picture in of_split.described:
            size = f"{split} {picture.camera.width} {picture.camera.height} "
            digest.update(size.encode() + picture.sha256.encode())
    return Scene(
        name=name,
        splits=splits,
        background=torch.full((3,), BACKGROUNDS[background]),
        bounds=box.in_unit_cube(),
        unit_length=box.side,
        digest=digest.hexdigest(),
        origin=box.origin.float(),
    )


def _check_float32(where: str, lengths: Sequence[float], others: Sequence[float]) -> None:
    """Raise unless all numbers fit into float32 and `lengths` stay positive in it."""
    good = all(SMALLEST <= x <= LARGEST for x in lengths) and all(abs(x) <= LARGEST for x in others)
    if not good:
        raise SteerbenchError(
            f"{where}: expected lengths that float32 has, {SMALLEST:.0e} to {LARGEST:.0e}, once "
            f"the box is the unit cube; got {[*lengths, *others]}: look at the poses and the bounds"
        )
