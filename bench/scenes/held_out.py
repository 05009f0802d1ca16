"""Training pictures held out of the training, to choose settings on."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

from bench.types import Scene, Split, SteerbenchError


def hold_out(scene: Scene, split: str, every: int) -> Scene:
    """`scene` without the middle one of every `every` training pictures, which are its `split`.

    Of a capture along a path, the first and the last picture stay in the training, so that what is
    held out lies between pictures to learn from. A split that is called `split` already is
    replaced. The digest is another, so that no training with these pictures is taken for one
    without.

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
    images = list(split.images)  # decoded together, which is faster than one after the other
    return Split(
        [split.cameras[index] for index in indices],
        [images[index] for index in indices],
        [split.names[index] for index in indices],
    )
