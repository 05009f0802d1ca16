"""From described views to a Scene: the last step that all loaders share."""

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
"""Lengths that float32 has at its full precision."""


def every_nth(views: Sequence[View], step: int, where: Path) -> dict[str, list[View]]:
    """Views in the order of their names: 0, step, 2 * step ... as test, all others as train.

    Raises:
        SteerbenchError: `step` is less than 2, or nothing is left to train on; `where` is named.
    """
    whole_number(step, "split_every", 2)
    views = sorted(views, key=lambda view: view.name)
    if len(views) < 2:
        got = f"{len(views)} pictures, each of which split_every={step} makes a test"
        raise unexpected(where, "a picture to train on", got)
    return {"train": [v for i, v in enumerate(views) if i % step], "test": views[::step]}


def leave_out(missing: Sequence[str], views: Sequence[View], where: str, log: Log) -> None:
    """Log the names of pictures that are `missing` beside `views`.

    Raises:
        SteerbenchError: there are no views.
    """
    if not views:
        raise unexpected(where, "pictures", f"none of {len(missing)} files is there")
    if missing:
        count = f"{len(missing)} of {len(views) + len(missing)}"
        log.info(f"{where}: {count} pictures are not there, left out: {', '.join(missing)}")


def describe_splits(
    views: Mapping[str, Sequence[View]], downscale: int, log: Log
) -> dict[str, Pictures]:
    """The pictures of every split, each read once; pixels are decoded when they are asked for."""
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
    """The scene in units in which `box` fills the unit cube.

    The digest covers the bytes of `camera_files` and of all picture files, the background, the
    resolution and the box.
    Raises SteerbenchError where the box, or a camera in its units, is beyond float32.
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
    """Raise unless float32 holds all of them, and `lengths` are more than 0 there."""
    good = all(SMALLEST <= x <= LARGEST for x in lengths) and all(abs(x) <= LARGEST for x in others)
    if not good:
        raise SteerbenchError(
            f"{where}: expected lengths that float32 has, {SMALLEST:.0e} to {LARGEST:.0e}, once "
            f"the box is the unit cube; got {[*lengths, *others]}: look at the poses and the bounds"
        )
