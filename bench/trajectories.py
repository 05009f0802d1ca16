"""Trajectories: the ordered cameras of a measurement, and which of them have ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.types import Camera, Scene, SteerbenchError


@dataclass(frozen=True)
class Step:
    """One frame: its camera, and the index of its ground truth in the split (None: unscored)."""

    camera: Camera
    truth: int | None


@dataclass(frozen=True)
class Trajectory:
    """The frames of one sequence, in the order in which they are rendered.

    Attributes:
        name: as it stands in result rows.
        split: the split of the scene that `Step.truth` counts in.
        steps: at least one.
    """

    name: str
    split: str
    steps: tuple[Step, ...]

    @property
    def resolution(self) -> str:
        """`WIDTHxHEIGHT` of the frames, or "mixed"."""
        sizes = {f"{step.camera.width}x{step.camera.height}" for step in self.steps}
        return sizes.pop() if len(sizes) == 1 else "mixed"


def spread(total: int, count: int) -> list[int]:
    """At most `count` different indices of `total`, evenly spread, first and last among them."""
    return np.linspace(0, total - 1, min(total, count)).round().astype(int).tolist()


def from_split(scene: Scene, split: str = "test", limit: int = 0) -> Trajectory:
    """The cameras of a split in their order; `limit` > 0 keeps that many, evenly spread.

    Raises:
        SteerbenchError: the scene has no such split, it is empty, or `limit` is negative.
    """
    if split not in scene.splits or not len(scene.splits[split]):
        raise SteerbenchError(
            f"trajectory.split: scene {scene.name} has no frames in {split!r}; "
            f"it has {', '.join(name for name, frames in scene.splits.items() if len(frames))}"
        )
    if limit < 0:
        raise SteerbenchError(f"trajectory.limit: expected 0 (all) or more, got {limit}")
    cameras = scene.splits[split].cameras
    kept = spread(len(cameras), limit or len(cameras))
    name = split if len(kept) == len(cameras) else f"{split}-{len(kept)}of{len(cameras)}"
    return Trajectory(name, split, tuple(Step(cameras[index], index) for index in kept))
