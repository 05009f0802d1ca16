"""Trajectories: the ordered cameras of a measurement, and which of them have ground truth.

They come from a split of the scene, from a file, or lead smoothly through key cameras. Functions
that make one raise SteerbenchError, which names the option, if a setting is out of its range or the
split is missing or empty; those along a smooth path, if pictures differ in size. `limit` 0 keeps
all cameras. `bench.motion` computes the motion between two poses, `bench.paths` reads files.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from bench.cameras import frame_camera
from bench.errors import unexpected
from bench.kinds import Size
from bench.motion import (
    between,
    lens_between,
    preceding,
    rotation_between,
    shift_of,
    viewing_target,
)
from bench.paths import MODEL, read_path
from bench.provenance import sha256
from bench.scenes.files import whole_number
from bench.scenes.remarks import Remarks
from bench.types import Camera, Cameras, Scene, SteerbenchError

MIXED = "mixed"  # the resolution of a trajectory whose frames differ in size

SAMPLES = 65
"""Poses per segment for measuring its length: 64 chords of half a circle are 0.01 % too short."""


@dataclass(frozen=True)
class Step:
    """One frame of a trajectory. The first one always counts as a cut, marked or not."""

    camera: Camera
    truth: int | None  # the index of its ground truth in the split; None: unscored
    cut: bool = False  # the camera jumped here instead of moving from the previous step


@dataclass(frozen=True)
class Trajectory:
    """The frames of one sequence, in the order in which they are rendered."""

    name: str  # as shown in result rows
    split: str  # the split of the scene that `Step.truth` indexes
    steps: tuple[Step, ...]  # at least one
    reads: tuple[Path, ...] = ()  # the files that the trajectory was read from
    notes: tuple[str, ...] = ()  # what a user should know of how they were read

    @property
    def resolution(self) -> str:
        """`WIDTHxHEIGHT` of the frames, or `MIXED`."""
        return resolution(step.camera.size for step in self.steps)

    @property
    def preceding(self) -> list[int]:
        """For each step, the number of steps before it since the last cut."""
        counts: list[int] = []
        for step in self.steps:
            counts.append(counts[-1] + 1 if counts and not step.cut else 0)
        return counts


def resized(trajectory: Trajectory, width: int, height: int) -> Trajectory:
    """The trajectory with frames of another size, which have no ground truth: only times count."""
    steps = (
        replace(step, camera=frame_camera(step.camera, width, height), truth=None)
        for step in trajectory.steps
    )
    return replace(trajectory, steps=tuple(steps))


def resolution(sizes: Iterable[Size]) -> str:
    """`WIDTHxHEIGHT` of pictures with these widths and heights, or `MIXED`."""
    names = {f"{width}x{height}" for width, height in sizes}
    return names.pop() if len(names) == 1 else MIXED


def spread(total: int, count: int) -> list[int]:
    """At most `count` distinct indices below `total`, evenly spread, from the first to the last."""
    return np.linspace(0, total - 1, min(total, count)).round().astype(int).tolist()


def from_split(scene: Scene, split: str = "test", limit: int = 0) -> Trajectory:
    """The cameras of a split in order, or `limit` evenly spread ones; a cut is at each gap."""
    cameras, kept, part = _kept(scene, split, limit, spaced=True)
    cuts = [False, *(after != before + 1 for before, after in pairwise(kept))]
    steps = (Step(cameras[index], index, cut) for index, cut in zip(kept, cuts, strict=True))
    return Trajectory(f"{split}{part}", split, tuple(steps))


def orbit(scene: Scene, split: str = "test", limit: int = 0) -> Trajectory:
    """The first `limit` cameras of a split in order, without gaps: if it was recorded along a path,
    preceding frames are true neighbours on that path."""
    cameras, kept, part = _kept(scene, split, limit)
    return Trajectory(f"{split}-orbit{part}", split, tuple(Step(cameras[k], k) for k in kept))


def smooth(scene: Scene, split: str = "test", degrees: float = 1.0, limit: int = 0) -> Trajectory:
    """A path through the first `limit` cameras; the frames between them have no ground truth.

    From frame to frame the camera turns by at most `degrees`, and what it looks at moves by no more
    as the camera sees it: `motion.shift_of`.
    """
    steps, part = _smooth_steps(scene, split, degrees, limit)
    return Trajectory(f"{split}-smooth{degrees:g}deg{part}", split, tuple(steps))


def jump(
    scene: Scene, split: str = "test", degrees: float = 1.0, every: int = 10, limit: int = 0
) -> Trajectory:
    """The smooth path, cut into pieces of `every` frames, in a fixed order that none follows on."""
    steps, part = _smooth_steps(scene, split, degrees, limit)
    allowed = f"1 to {len(steps) - 1}, fewer than the {len(steps)} frames of the path"
    got = f"{every}; trajectory.limit=0 takes all cameras"
    _check(1 <= every < len(steps), "every", allowed, got)
    jumps: list[Step] = []
    for piece in _shuffled(-(-len(steps) // every)):
        first, *others = steps[piece * every : (piece + 1) * every]
        jumps += [replace(first, cut=True), *others]
    return Trajectory(f"{split}-jump{every}-{degrees:g}deg{part}", split, tuple(jumps))


def loop(
    scene: Scene, split: str = "test", degrees: float = 1.0, frames: int = 1000, limit: int = 0
) -> Trajectory:
    """The smooth path back and forth, so that drift shows in scores of the same pictures."""
    _check(frames >= 1, "frames", "1 or more", frames)
    there, part = _smooth_steps(scene, split, degrees, limit)
    round_trip = there + there[-2:0:-1]
    steps = tuple(round_trip[index % len(round_trip)] for index in range(frames))
    return Trajectory(f"{split}-loop{frames}-{degrees:g}deg{part}", split, steps)


def static(scene: Scene, split: str = "test", view: int = 0, frames: int = 60) -> Trajectory:
    """A still camera: camera `view` of a split, repeated for `frames` frames."""
    cameras, kept, _ = _kept(scene, split, 0)
    allowed = f"0 to {len(cameras) - 1}, the cameras of {split!r}"
    _check(view in kept, "view", allowed, view)
    _check(frames >= 1, "frames", "1 or more", frames)
    return Trajectory(f"{split}-static{view}", split, (Step(cameras[view], view),) * frames)


def approached(
    scene: Scene, split: str, lead: int, degrees: float, seed: int, limit: int
) -> Trajectory:
    """Scattered cameras of a split, each reached by its own random smooth motion.

    The `lead` frames before a camera have no ground truth; the first of them comes after a cut.
    From frame to frame the camera turns by `degrees` about what it looks at (`motion.preceding`).
    `seed` seeds the motions; only `limit` cameras, evenly spread, are approached.
    """
    _check(lead >= 0, "lead", "0 or more", lead)
    _check(0 < degrees <= 180, "degrees", "more than 0, up to 180", degrees)
    cameras, kept, part = _kept(scene, split, limit, spaced=True)
    target, generator = viewing_target(scene), torch.Generator().manual_seed(seed)
    steps: list[Step] = []
    for index in kept:
        before = preceding(cameras[index], target, lead, (degrees, degrees), generator)
        steps += [Step(camera, None, cut=n == 0) for n, camera in enumerate(before)]
        steps.append(Step(cameras[index], index, cut=not before))
    name = f"{split}-approached{lead}-{degrees:g}deg{part}{f'-seed{seed}' if seed else ''}"
    return Trajectory(name, split, tuple(steps))


def _kept(
    scene: Scene, split: str, limit: int, *, spaced: bool = False
) -> tuple[Cameras, list[int], str]:
    """The cameras of a split; the indices of the first, or evenly `spaced`, `limit` (0: all) of
    them; and the part of the trajectory's name that says how many these are."""
    if split not in scene.splits or not len(scene.splits[split]):
        others = ", ".join(name for name, frames in scene.splits.items() if len(frames))
        raise SteerbenchError(
            f"trajectory.split: scene {scene.name} has no frames in {split!r}; it has {others}"
        )
    _check(limit >= 0, "limit", "0 (all) or more", limit)
    cameras = scene.splits[split].cameras
    count = min(limit or len(cameras), len(cameras))
    kept = spread(len(cameras), count) if spaced else list(range(count))
    return cameras, kept, "" if count == len(cameras) else f"-{count}of{len(cameras)}"


def _smooth_steps(scene: Scene, split: str, degrees: float, limit: int) -> tuple[list[Step], str]:
    """The steps of the smooth path through the first `limit` cameras, and its name's ending."""
    _check(0 < degrees < math.inf, "degrees", "more than 0", degrees)
    cameras, kept, part = _kept(scene, split, limit)
    target, steps = viewing_target(scene), [Step(cameras[0], 0)]
    for first, second in pairwise(kept):
        turn = rotation_between(cameras[first], cameras[second])
        angle = max(turn.norm().item(), shift_of(target, cameras[first], cameras[second]))
        # 1e-3: cameras that are `degrees` apart need no frame between them, despite rounding.
        count = max(math.ceil(math.degrees(angle) / degrees - 1e-3), 1)
        shares = (k / count for k in range(1, count))
        steps += [Step(between(cameras[first], cameras[second], turn, s), None) for s in shares]
        steps.append(Step(cameras[second], second))
    return steps, part


def _shuffled(count: int) -> list[int]:
    """0 to count - 1 in a fixed random order in which k + 1 never follows k; count >= 2."""
    random = np.random.default_rng(0)
    while True:  # about one order in three qualifies
        order = random.permutation(count).tolist()
        if all(after != before + 1 for before, after in pairwise(order)):
            return order


def _check(holds: bool, option: str, expected: str, got: object) -> None:
    if not holds:
        raise unexpected(f"trajectory.{option}", expected, got)


def follow(scene: Scene, path: str, limit: int = 0, transforms: str | None = None) -> Trajectory:
    """The first `limit` cameras of a file (0: all), in order and without ground truth.

    `transforms` says how a model of nerfstudio moved the data set, by default the file of that name
    beside the path. Raises SteerbenchError as `read_path` does.
    """
    file = Path(path).expanduser().resolve()
    model = Path(transforms).expanduser().resolve() if transforms else None
    reads = [f for f in (file, model or file.with_name(MODEL)) if f.is_file()]
    remarks, notes = Remarks(), list[str]()
    cameras = read_path(file, scene, remarks, model)
    remarks.tell(notes.append)
    whole_number(limit, "trajectory.limit", 0)
    steps = tuple(Step(camera, truth=None) for camera in cameras[: limit or None])
    name = f"{file.stem}-{sha256(file)[:6]}"  # many files are called path.json
    return Trajectory(name, "test", steps, tuple(reads), tuple(notes))


def spline(
    scene: Scene, path: str | None, split: str = "test", keys: int = 6, degrees: float = 1.0
) -> Trajectory:
    """A smooth path through a few key cameras, in steps of at most `degrees`; see `leading`.

    All cameras of the file `path` are keys, see `follow`; without a file, so many `keys` are evenly
    spread over the `split`, and only they have ground truth. Raises SteerbenchError as `follow`,
    `from_split` and `leading` do.
    """
    _check(0 < degrees < math.inf, "degrees", "more than 0", degrees)
    whole_number(keys, "trajectory.keys", 2)
    through = follow(scene, path) if path else from_split(scene, split, keys)
    first, *others = through.steps
    pieces = leading([step.camera for step in through.steps], viewing_target(scene), degrees)
    steps = [first]
    for key, piece in zip(others, pieces, strict=True):
        steps += [*(Step(camera, truth=None) for camera in piece[:-1]), replace(key, cut=False)]
    name = f"{through.name}-spline{degrees:g}deg"
    return Trajectory(name, through.split, tuple(steps), through.reads, through.notes)


def leading(keys: Cameras, target: Tensor, degrees: float) -> list[list[Camera]]:
    """A smooth path through `keys`, one segment for each key but the first.

    A segment holds the cameras after the previous key, up to and including its own, evenly spaced
    by at most `degrees`. Centres follow a cubic spline, rotations one with continuous angular
    acceleration, both by length: the angle of the camera's rotation or of its centre's motion as
    seen from `target` [3], whichever is larger.

    Raises SteerbenchError if there are fewer than two keys, two consecutive keys with the same
    pose, or keys whose pictures differ in size.
    """
    poses = torch.stack([camera.c2w.double() for camera in keys]).numpy()
    turns, centres = Rotation.from_matrix(poses[:, :, :3]), poses[:, :, 3]
    lengths = _lengths(turns, centres, target)
    if not (len(lengths) and lengths.min() > 0):
        raise unexpected("spline", "two cameras or more", "fewer, or one at the pose before it")
    knots = np.concatenate(([0.0], lengths.cumsum()))
    turning, moving = RotationSpline(knots, turns), CubicSpline(knots, centres)
    pieces = []
    for (first, second), (start, end) in zip(pairwise(keys), pairwise(knots), strict=True):
        fine = np.linspace(start, end, SAMPLES)
        gone = np.concatenate(([0.0], _lengths(turning(fine), moving(fine), target).cumsum()))
        count = max(math.ceil(math.degrees(gone[-1]) / degrees - 1e-3), 1)
        at = np.interp(np.linspace(0, gone[-1], count + 1)[1:-1], gone, fine)
        piece = []
        for time in at:
            camera = lens_between(first, second, float((time - start) / (end - start)))
            pose = np.column_stack((turning(time).as_matrix(), moving(time)))
            piece.append(replace(camera, c2w=torch.from_numpy(pose).to(first.c2w)))
        pieces.append([*piece, second])
    return pieces


def _lengths(turns: Rotation, centres: np.ndarray, target: Tensor) -> np.ndarray:
    """The length [N - 1] in radians from each of N poses to the next; see `leading`."""
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    far = np.linalg.norm(centres - target.double().numpy(), axis=1)
    return np.maximum((turns[:-1].inv() * turns[1:]).magnitude(), np.arctan2(moved, far[:-1]))
