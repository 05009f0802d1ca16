"""What the network is shown, and the picture that it corrects, with numba: one pass over the rows
of a picture, each of which stays in the cache until it is complete."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.kernels.cpu import arrays, check_float32, f32, jit

Axis = tuple[Tensor, Tensor, Tensor]
"""Of each place along a side of the picture: the two pixels it lies between, and how near it is to
the second, 0 to 1."""


def shown(
    present: Tensor,
    values: Tensor,
    index: Tensor,
    frames: int,
    memory: Tensor,
) -> Tensor:
    """As the reference, of numbers of 16 or 32 bits, which are moved and not computed; in `memory`
    if that has room."""
    shape = torch.Size((*index.shape[1:], present.shape[2] * (frames + 1)))
    fits = memory.dtype == present.dtype and len(memory) >= shape.numel()
    out = memory[: shape.numel()].view(shape) if fits else present.new_empty(shape)
    moved = (x.view(torch.int16) if x.dtype.itemsize == 2 else x for x in (present, values, out))
    present, values, filled = moved
    _shown(*arrays(present, values, index), frames + 1, filled.numpy())
    return out


def collected(
    grad: Tensor, index: Tensor, frames: int, size: tuple[int, int], points: int
) -> tuple[Tensor, Tensor]:
    """As the reference, of float32."""
    check_float32(grad)
    features = grad.shape[2] // (frames + 1)
    present, values = torch.empty(*size, features), torch.zeros(points, features)
    _collected(*arrays(grad, index, present, values), frames + 1)
    return present, values


def corrected(
    rgb: Tensor,
    correction: Tensor,
    corner: tuple[int, int],
    scale: int,
    aligned: bool,
    *,
    clip: bool,
) -> Tensor:
    """As the reference, of float32."""
    correction = correction.float()
    check_float32(rgb)
    down, across = (_axis(side, scale, aligned) for side in rgb.shape[:2])
    out = torch.empty(len(down[0]), len(across[0]), 3)
    given = arrays(rgb, correction, *down, *across, out)
    _corrected(*given, *corner, clip)
    return out


def reduced(grad: Tensor, size: tuple[int, int], scale: int, aligned: bool) -> Tensor:
    """As the reference, of float32."""
    check_float32(grad)
    down, across = (_axis(side, scale, aligned) for side in size)
    rows, sums = torch.zeros(len(grad), size[1], 3), torch.zeros(*size, 3)
    _reduced(*arrays(grad, *down, *across, rows, sums))
    return sums


@lru_cache(maxsize=16)
def _axis(side: int, scale: int, aligned: bool) -> Axis:
    """The places of the `scale` times as many pixels of a side of `side` pixels."""
    place = torch.arange(side * scale, dtype=torch.float64)
    if aligned:
        place = ((place + 0.5) / scale - 0.5).clamp(min=0)
    else:
        place *= (side - 1) / max(side * scale - 1, 1)
    first = place.long().clamp(max=side - 1)
    return first.int(), (first + 1).clamp(max=side - 1).int(), (place - first).float()


@jit(parallel=True)
def _shown(present, values, index, frames, out):
    step = out.shape[0] // present.shape[0]
    for row in prange(out.shape[0]):
        line = out[row]
        line[:] = 0
        if row % step == 0:
            for column in range(present.shape[1]):
                _put(present[row // step, column], 0, frames, line[column * step])
        for frame in range(index.shape[0]):
            for column in range(out.shape[1]):
                point = index[frame, row, column]
                if point >= 0:
                    _put(values[point], frame + 1, frames, line[column])


@jit()
def _put(features, frame, frames, pixel):
    """Write the features of one of the frames to a pixel: RGB of all come first."""
    for k in range(3):
        pixel[3 * frame + k] = features[k]
    rest = len(features) - 3
    for k in range(rest):
        pixel[3 * frames + rest * frame + k] = features[3 + k]


@jit(parallel=True)
def _collected(grad, index, present, values, frames):
    """Adjoint of `_shown`. A thread a frame, because frames share no points."""
    step = grad.shape[0] // present.shape[0]
    present[:] = 0
    for frame in prange(index.shape[0] + 1):
        if frame == 0:
            for row in range(present.shape[0]):
                for column in range(present.shape[1]):
                    _add(grad[row * step, column * step], 0, frames, present[row, column])
        else:
            for row in range(grad.shape[0]):
                for column in range(grad.shape[1]):
                    point = index[frame - 1, row, column]
                    if point >= 0:
                        _add(grad[row, column], frame, frames, values[point])


@jit()
def _add(pixel, frame, frames, features):
    """Adjoint of `_put`."""
    for k in range(3):
        features[k] += pixel[3 * frame + k]
    rest = len(features) - 3
    for k in range(rest):
        features[3 + k] += pixel[3 * frames + rest * frame + k]


@jit(parallel=True)
def _corrected(
    rgb, correction, above, below, lower, left, right, nearer, out, top, start, clip
):  # fmt: skip
    for y in prange(out.shape[0]):
        first, second, share = rgb[above[y]], rgb[below[y]], lower[y]
        line, between = out[y], np.empty_like(rgb[0])
        for column in range(len(between)):
            for c in range(3):
                between[column, c] = _mixed(first[column, c], second[column, c], share)
        for x in range(out.shape[1]):
            for c in range(3):
                line[x, c] = _mixed(between[left[x], c], between[right[x], c], nearer[x])
        if top <= y < top + correction.shape[0]:
            added = correction[y - top]
            for x in range(len(added)):
                for c in range(3):
                    line[start + x, c] += added[x, c]
        if clip:
            for x in range(out.shape[1]):
                for c in range(3):
                    v = line[x, c]
                    line[x, c] = f32(0) if v < 0 else f32(1) if v > 1 else v  # NaN stays


@jit()
def _mixed(first, second, share):
    return first * (f32(1) - share) + second * share


@jit(parallel=True)
def _reduced(grad, above, below, lower, left, right, nearer, rows, sums):
    """Adjoint of enlarging: first along the rows of the picture, then along its columns."""
    for y in prange(grad.shape[0]):
        for x in range(grad.shape[1]):
            for c in range(3):
                rows[y, left[x], c] += grad[y, x, c] * (f32(1) - nearer[x])
                rows[y, right[x], c] += grad[y, x, c] * nearer[x]
    for row in prange(sums.shape[0]):
        for y in range(grad.shape[0]):
            if above[y] == row or below[y] == row:
                first = f32(1) - lower[y] if above[y] == row else f32(0)
                share = first + lower[y] if below[y] == row else first
                for x in range(sums.shape[1]):
                    for c in range(3):
                        sums[row, x, c] += rows[y, x, c] * share
