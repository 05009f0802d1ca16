"""Smooth camera paths through a few given cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline
from torch import Tensor

from bench.motion import lens_between
from bench.types import Camera, SteerbenchError

SAMPLES = 65
"""Poses per segment for measuring its length: 64 chords of half a circle are 0.01 % too short."""


def leading(keys: Sequence[Camera], target: Tensor, degrees: float) -> list[list[Camera]]:
    """A smooth path through `keys`, one segment for each key but the first.

    A segment holds the cameras after the previous key, up to and including its own key. Centres
    follow a cubic spline, rotations a spline with continuous angular acceleration. Both are
    parametrised by length, measured as an angle: the camera's rotation, or the motion of its centre
    as seen from `target` [3], whichever is larger. The cameras of a segment are evenly spaced, by
    at most `degrees`.

    Raises:
        SteerbenchError: fewer than two keys, two consecutive keys with the same pose, or keys
            whose pictures differ in size.
    """
    poses = torch.stack([camera.c2w.double() for camera in keys]).numpy()
    turns, centres = Rotation.from_matrix(poses[:, :, :3]), poses[:, :, 3]
    lengths = _lengths(turns, centres, target)
    if not (len(lengths) and lengths.min() > 0):
        raise SteerbenchError("spline: expected two cameras or more, none at the pose before it")
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
