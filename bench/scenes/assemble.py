"""Makes a Scene from described views, the last step of every loader; holds pictures out of it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from bench.cameras import move_camera
from bench.errors import unexpected
from bench.scenes.bounds import Box
from bench.scenes.files import whole_number
from bench.scenes.images import Pictures, View, describe
from bench.threads import in_parallel
from bench.types import BACKGROUNDS, Log, Scene, Split


def every_nth(views: Sequence[View], step: int, where: Path) -> dict[str, list[View]]:
    """Split views, sorted by name: 0, step, 2 * step ... are the test split, the others train.

    Raises SteerbenchError if `step` is less than 2, or nothing is left to train on.
    """
    whole_number(step, "split_every", 2)
    views = sorted(views, key=lambda view: view.name)
    if len(views) < 2:
        got = f"{len(views)} pictures, each of which split_every={step} makes a test"
        raise unexpected(where, "a picture to train on", got)
    return {"train": [v for i, v in enumerate(views) if i % step], "test": views[::step]}


def leave_out(missing: Sequence[str], views: Sequence[View], where: str, log: Log) -> None:
    """Log the names of `missing` pictures; raises SteerbenchError if there are no other `views`."""
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
    every = [view for split in views.values() for view in split]
    described = iter(
        in_parallel(lambda view: describe(view, downscale), every, "read pictures", log)
    )
    return {name: Pictures([next(described) for _ in split], log) for name, split in views.items()}


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
        raise unexpected("background", " or ".join(BACKGROUNDS), repr(background))
    _check_float32("bounds", [box.side], box.origin.tolist())
    splits = {}
    for split, of_split in pictures.items():
        shown = of_split.described
        scale, offset = 1 / box.side, -box.origin / box.side
        cameras = [move_camera(picture.camera, scale, offset) for picture in shown]
        names = [picture.view.name for picture in shown]
        for view, camera in zip(names, cameras, strict=True):
            others = [camera.cx, camera.cy, *camera.c2w.flatten().tolist()]
            _check_float32(view, [camera.fx, camera.fy], others)
        splits[split] = Split(cameras, of_split, names)
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
    )
