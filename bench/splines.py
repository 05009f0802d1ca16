"""Camera paths without corners through a few given cameras."""

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
"""Poses along a piece of a spline that its length is measured with: 64 chords of an arc of half a
turn miss 0.01 % of it."""


def leading(keys: Sequence[Camera], target: Tensor, degrees: float) -> list[list[Camera]]:
    """A path without corners through `keys`: for each but the first the cameras that lead to it
    from the one before, the key itself as the last.

    Centres follow a cubic spline, rotations one of continuous angular acceleration. Both run over
    the length of the way, an angle: by how much the camera turns or, if that is more, its centre
    moves, seen from `target` [3]. The cameras of a piece are evenly spaced, by at most `degrees`.

    Raises:
        SteerbenchError: fewer than two keys, two in a row with the same pose, or keys whose
            pictures differ in size.
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
    """The length [N - 1] of the way from each of N poses to the next, radians; see `leading`."""
    moved = np.linalg.norm(np.diff(centres, axis=0), axis=1)
    far = np.linalg.norm(centres - target.double().numpy(), axis=1)
    return np.maximum((turns[:-1].inv() * turns[1:]).magnitude(), np.arctan2(moved, far[:-1]))
