"""Trajectories: the ordered cameras of a measurement, and which of them have ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from kornia.geometry.conversions import (
    axis_angle_to_rotation_matrix,
    rotation_matrix_to_axis_angle,
)
from torch import Tensor

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
    cameras = _cameras(scene, split, limit)
    kept = spread(len(cameras), limit or len(cameras))
    name = split if len(kept) == len(cameras) else f"{split}-{len(kept)}of{len(cameras)}"
    return Trajectory(name, split, tuple(Step(cameras[index], index) for index in kept))


def smooth(scene: Scene, split: str = "test", degrees: float = 1.0, limit: int = 0) -> Trajectory:
    """A path through the cameras of a split that turns by at most `degrees` from frame to frame.

    Frames between two cameras have no ground truth: they are rendered and timed, not scored.
    `limit` > 0 keeps the first that many cameras, so that the path has no gaps.

    Raises:
        SteerbenchError: as `from_split`; `degrees` is not positive, or picture sizes differ.
    """
    if not degrees > 0:
        raise SteerbenchError(f"trajectory.degrees: expected more than 0, got {degrees}")
    cameras = _cameras(scene, split, limit)
    kept = cameras[: limit or len(cameras)]
    steps = [Step(kept[0], 0)]
    for index, (first, second) in enumerate(pairwise(kept), 1):
        turn = _rotation_between(first, second)
        # Cameras that are `degrees` apart are neighbours, whatever the rounding of their poses.
        count = max(math.ceil(math.degrees(turn.norm().item()) / degrees - 1e-3), 1)
        steps += [Step(_between(first, second, turn, k / count), None) for k in range(1, count)]
        steps.append(Step(second, index))
    part = "" if len(kept) == len(cameras) else f"-{len(kept)}of{len(cameras)}"
    return Trajectory(f"{split}-smooth{degrees:g}deg{part}", split, tuple(steps))


def static(scene: Scene, split: str = "test", view: int = 0, frames: int = 60) -> Trajectory:
    """The camera stands still: `frames` times camera `view` of a split.

    Raises:
        SteerbenchError: as `from_split`; there is no such view, or `frames` is less than 1.
    """
    cameras = _cameras(scene, split, 0)
    if not 0 <= view < len(cameras):
        raise SteerbenchError(
            f"trajectory.view: expected 0 to {len(cameras) - 1}, the cameras of {split!r}, "
            f"got {view}"
        )
    if frames < 1:
        raise SteerbenchError(f"trajectory.frames: expected 1 or more, got {frames}")
    return Trajectory(f"{split}-static{view}", split, (Step(cameras[view], view),) * frames)


def _cameras(scene: Scene, split: str, limit: int) -> Sequence[Camera]:
    if split not in scene.splits or not len(scene.splits[split]):
        raise SteerbenchError(
            f"trajectory.split: scene {scene.name} has no frames in {split!r}; "
            f"it has {', '.join(name for name, frames in scene.splits.items() if len(frames))}"
        )
    if limit < 0:
        raise SteerbenchError(f"trajectory.limit: expected 0 (all) or more, got {limit}")
    return scene.splits[split].cameras


def _rotation_between(first: Camera, second: Camera) -> Tensor:
    """The rotation [3] from one camera to the other, axis times angle, in the first one's axes."""
    relative = first.c2w[:, :3].double().T @ second.c2w[:, :3].double()
    return rotation_matrix_to_axis_angle(relative[None])[0]


def _between(first: Camera, second: Camera, turn: Tensor, share: float) -> Camera:
    """The camera at `share` of the way: rotated evenly, everything else interpolated linearly.

    On an orbit the centre takes the chord: at 4 degrees it is off by 0.06 % of the distance.
    """
    if (first.width, first.height) != (second.width, second.height):
        raise SteerbenchError(
            "trajectory: expected pictures of one size to interpolate between, got "
            f"{first.width}x{first.height} and {second.width}x{second.height}"
        )
    rotation = first.c2w[:, :3].double() @ axis_angle_to_rotation_matrix(share * turn[None])[0]
    centre = torch.lerp(first.c2w[:, 3].double(), second.c2w[:, 3].double(), share)
    inner = {
        name: (1 - share) * getattr(first, name) + share * getattr(second, name)
        for name in ("fx", "fy", "cx", "cy")
    }
    c2w = torch.cat((rotation, centre[:, None]), dim=1).to(first.c2w)
    return replace(first, c2w=c2w, **inner)
