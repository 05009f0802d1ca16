"""Holds training pictures out of the training, to choose settings on them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

from bench.types import Scene, Split, SteerbenchError


def hold_out(scene: Scene, split: str, every: int) -> Scene:
    """Move the middle one of every `every` training pictures to a split called `split`.

    In a capture along a path, the first and last picture stay in the training, so that held-out
    pictures lie between training pictures. An existing split of that name is replaced. The digest
    changes, so that trainings with and without these pictures are not confused.

    Raises:
        SteerbenchError: there are fewer than `every` training pictures.
    """
    train = scene.splits["train"]
    if len(train) < every:
        raise SteerbenchError(
            f"split={split}: expected at least {every} training pictures, of which one in {every} "
            f"is held out, got {len(train)} of {scene.name}"
        )
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
