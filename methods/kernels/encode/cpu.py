"""Hash-grid encoding with numba: 16 samples per AVX-512 register, table reads as gathers.

One level of a chunk of samples is done in three short passes over buffers that stay in the L1
cache: indices and weights of the eight corners, gather, blend. Each pass is a loop that LLVM can
vectorise: the buffers are flat, with corner k at the constant offset k * CHUNK, because only then
can LLVM prove that they do not overlap.

Forward: a thread takes a chunk and goes through the levels. Backward: a thread takes a level and
goes through the chunks, so that no two threads add to the same entry: this needs no atomics, and
the sums are the same in every run.
"""

import numpy as np
import torch
from numba import get_num_threads, prange
from torch import Tensor

from methods.kernels.cpu import (
    FAST,
    add_pair,
    arrays,
    check_float32,
    f32,
    i32,
    jit,
    pack_bf16,
    u32,
    u64,
)
from methods.kernels.encode import PRIMES, HashGrid

CHUNK = 256  # samples; 256 * (8 indices + 8 weights + 8 values) * 4 bytes = 24 KiB

PRIME_Y, PRIME_Z = u32(PRIMES[1]), u32(PRIMES[2])


def encode(positions: Tensor, table: Tensor, grid: HashGrid, packed: Tensor | None) -> Tensor:
    if positions.requires_grad:
        raise ValueError("backend 'cpu' gives no gradient for positions: use backend='reference'")
    check_float32(positions, table)
    return _Encode.apply(positions.contiguous(), table, grid, packed)


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx, positions, table, grid, packed):
        ctx.save_for_backward(positions)
        ctx.grid = grid
        shapes = level_arrays(grid)
        if packed is None:
            features = torch.empty(len(positions), grid.channels)
            _encode_float(*arrays(positions, table), *shapes, features.numpy())
            return features
        words = torch.empty(len(positions), grid.levels, dtype=torch.int32)
        _encode_packed(positions.numpy(), _unsigned(packed), *shapes, _unsigned(words))
        return words.view(torch.bfloat16)

    @staticmethod
    def backward(ctx, grad):
        (positions,) = ctx.saved_tensors
        grid = ctx.grid
        target = torch.zeros(grid.entries, grid.features)
        given = *arrays(positions, by_channel(grad)), *level_arrays(grid)
        _scatter(*given, target.view(-1).numpy(), get_num_threads())
        return None, target, None, None


def by_channel(grad: Tensor) -> Tensor:
    """The gradient [N, channels] as float32 [channels, N]: so a level reads only its own."""
    if grad.dtype != torch.bfloat16 or grad.shape[1] % 2:
        return grad.T.contiguous().float()
    columns = torch.empty(grad.shape[1], len(grad))
    _widen_by_channel(_unsigned(grad.contiguous().view(torch.int32)), columns.numpy())
    return columns


def _unsigned(words: Tensor) -> np.ndarray:
    return words.numpy().view(np.uint32)


def level_arrays(grid: HashGrid) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`HashGrid.scales`, `strides` and `offsets`."""
    strides, offsets = np.array(grid.strides, np.uint32), np.array(grid.offsets, np.int64)
    return np.array(grid.scales, np.float32), strides, offsets


@jit(fastmath=FAST)
def _load(positions, first, count, xyz):
    """Copy positions [first, first + count) axis by axis, clamped to [0, 1], NaN as 0: it must not
    become an address."""
    for axis in range(3):
        for i in range(count):
            value = positions[first + i, axis]
            value = value if value > f32(0) else f32(0)
            xyz[axis * CHUNK + i] = value if value < f32(1) else f32(1)


@jit(fastmath=FAST)
def _weights(x, y, z, scale):
    """Cell and trilinear weights of a position; those along y and z are already multiplied."""
    px, py, pz = x * scale + f32(0.5), y * scale + f32(0.5), z * scale + f32(0.5)
    ix, iy, iz = i32(px), i32(py), i32(pz)
    fx, fy, fz = px - f32(ix), py - f32(iy), pz - f32(iz)
    gx, gy, gz = f32(1) - fx, f32(1) - fy, f32(1) - fz
    return u32(ix), u32(iy), u32(iz), gx, fx, gy * gz, fy * gz, gy * fz, fy * fz


@jit(fastmath=FAST)
def _put_weights(weight, i, gx, fx, w00, w10, w01, w11):
    """Weights of the eight corners of sample i, x varying fastest."""
    weight[i], weight[CHUNK + i] = gx * w00, fx * w00
    weight[2 * CHUNK + i], weight[3 * CHUNK + i] = gx * w10, fx * w10
    weight[4 * CHUNK + i], weight[5 * CHUNK + i] = gx * w01, fx * w01
    weight[6 * CHUNK + i], weight[7 * CHUNK + i] = gx * w11, fx * w11


@jit(fastmath=FAST)
def _corners_hashed(xyz, count, scale, mask, index, weight):
    for i in range(count):
        ix, iy, iz, gx, fx, w00, w10, w01, w11 = _weights(
            xyz[i], xyz[CHUNK + i], xyz[2 * CHUNK + i], scale
        )
        x1 = u32(ix + u32(1))
        y0, z0 = u32(iy * PRIME_Y), u32(iz * PRIME_Z)
        y1, z1 = u32(y0 + PRIME_Y), u32(z0 + PRIME_Z)
        h00, h10, h01, h11 = u32(y0 ^ z0), u32(y1 ^ z0), u32(y0 ^ z1), u32(y1 ^ z1)
        index[i] = u32(ix ^ h00) & mask
        index[CHUNK + i] = u32(x1 ^ h00) & mask
        index[2 * CHUNK + i] = u32(ix ^ h10) & mask
        index[3 * CHUNK + i] = u32(x1 ^ h10) & mask
        index[4 * CHUNK + i] = u32(ix ^ h01) & mask
        index[5 * CHUNK + i] = u32(x1 ^ h01) & mask
        index[6 * CHUNK + i] = u32(ix ^ h11) & mask
        index[7 * CHUNK + i] = u32(x1 ^ h11) & mask
        _put_weights(weight, i, gx, fx, w00, w10, w01, w11)


@jit(fastmath=FAST)
def _wrap(entry, size):
    """entry mod size, for entry < 2 size."""
    return u32(entry - size) if entry >= size else entry


@jit(fastmath=FAST)
def _corners_dense(xyz, count, scale, stride, size, index, weight):
    slice_ = u32(stride * stride)
    for i in range(count):
        ix, iy, iz, gx, fx, w00, w10, w01, w11 = _weights(
            xyz[i], xyz[CHUNK + i], xyz[2 * CHUNK + i], scale
        )
        b00 = u32(ix + u32(u32(iy * stride) + u32(iz * slice_)))
        b10, b01 = u32(b00 + stride), u32(b00 + slice_)
        b11 = u32(b01 + stride)
        index[i] = _wrap(b00, size)
        index[CHUNK + i] = _wrap(u32(b00 + u32(1)), size)
        index[2 * CHUNK + i] = _wrap(b10, size)
        index[3 * CHUNK + i] = _wrap(u32(b10 + u32(1)), size)
        index[4 * CHUNK + i] = _wrap(b01, size)
        index[5 * CHUNK + i] = _wrap(u32(b01 + u32(1)), size)
        index[6 * CHUNK + i] = _wrap(b11, size)
        index[7 * CHUNK + i] = _wrap(u32(b11 + u32(1)), size)
        _put_weights(weight, i, gx, fx, w00, w10, w01, w11)


@jit()
def _corners(xyz, count, scale, stride, size, index, weight):
    if stride:
        _corners_dense(xyz, count, scale, stride, size, index, weight)
    else:
        _corners_hashed(xyz, count, scale, u32(size - u32(1)), index, weight)


@jit()
def _gather(level_table, index, count, value):
    for corner in range(8):
        for i in range(count):
            value[corner * CHUNK + i] = level_table[index[corner * CHUNK + i]]


@jit(fastmath=FAST)
def _blend(value, weight, count, blended):
    for i in range(count):
        total = f32(0)
        for corner in range(8):
            total += weight[corner * CHUNK + i] * value[corner * CHUNK + i]
        blended[i] = total


@jit(fastmath=FAST)
def _blend_packed(word, weight, count, blended):
    for i in range(count):
        low, high = f32(0), f32(0)
        for corner in range(8):
            pair = word[corner * CHUNK + i]
            w = weight[corner * CHUNK + i]
            low += w * u32(pair << u32(16)).view(np.float32)
            high += w * u32(pair & u32(0xFFFF0000)).view(np.float32)
        blended[i] = pack_bf16(low, high)


@jit(parallel=True)
def _encode_packed(positions, table, scales, strides, offsets, out):
    total, levels = out.shape
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        first = chunk * CHUNK
        count = min(CHUNK, total - first)
        xyz = np.empty(3 * CHUNK, np.float32)
        index, word = np.empty(8 * CHUNK, np.uint32), np.empty(8 * CHUNK, np.uint32)
        weight = np.empty(8 * CHUNK, np.float32)
        blended = np.empty((levels, CHUNK), np.uint32)
        _load(positions, first, count, xyz)
        for level in range(levels):
            begin, end = offsets[level], offsets[level + 1]
            _corners(xyz, count, scales[level], strides[level], u32(end - begin), index, weight)
            _gather(table[begin:end], index, count, word)
            _blend_packed(word, weight, count, blended[level])
        for i in range(count):
            for level in range(levels):
                out[first + i, level] = blended[level, i]


@jit(parallel=True)
def _encode_float(positions, table, scales, strides, offsets, out):
    total, channels = out.shape
    levels, features = len(scales), table.shape[1]
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        first = chunk * CHUNK
        count = min(CHUNK, total - first)
        xyz = np.empty(3 * CHUNK, np.float32)
        index = np.empty(8 * CHUNK, np.uint32)
        weight, value = np.empty(8 * CHUNK, np.float32), np.empty(8 * CHUNK, np.float32)
        blended = np.empty((channels, CHUNK), np.float32)
        _load(positions, first, count, xyz)
        for level in range(levels):
            begin, end = offsets[level], offsets[level + 1]
            _corners(xyz, count, scales[level], strides[level], u32(end - begin), index, weight)
            for feature in range(features):
                _gather(table[begin:end, feature], index, count, value)
                _blend(value, weight, count, blended[level * features + feature])
        for i in range(count):
            for channel in range(channels):
                out[first + i, channel] = blended[channel, i]


@jit(parallel=True)
def _widen_by_channel(words, columns):
    """Pairs of bfloat16 [N, C / 2] as float32 [C, N]."""
    total, pairs = words.shape
    for chunk in prange((total + CHUNK - 1) // CHUNK):
        for pair in range(pairs):
            for i in range(chunk * CHUNK, min(total, (chunk + 1) * CHUNK)):
                word = words[i, pair]
                columns[2 * pair, i] = u32(word << u32(16)).view(np.float32)
                columns[2 * pair + 1, i] = u32(word & u32(0xFFFF0000)).view(np.float32)


@jit()
def _scatter_pairs(index, weight, count, first, second, target):
    for i in range(count):
        for corner in range(8):
            at = u64(corner * CHUNK) + u64(i)
            place = u64(2) * u64(index[at])
            add_pair(target, place, weight[at], first[i], second[i])


@jit()
def _scatter_one(index, weight, count, grad, target, feature, features):
    for i in range(count):
        for corner in range(8):
            at = u64(corner * CHUNK) + u64(i)
            place = u64(features) * u64(index[at]) + u64(feature)
            target[place] += weight[at] * grad[i]


@jit()
def scatter_level(level, positions, grad, scales, strides, offsets, target):
    """Adjoint of `_encode_float` at one level: target[corner] += weight * grad. `grad` is
    [channels, N], of all levels; `target` the level's [entries, features], flat."""
    features, total = len(grad) // len(scales), len(positions)
    size = u32(offsets[level + 1] - offsets[level])
    xyz = np.empty(3 * CHUNK, np.float32)
    index, weight = np.empty(8 * CHUNK, np.uint32), np.empty(8 * CHUNK, np.float32)
    for first in range(0, total, CHUNK):
        count = min(CHUNK, total - first)
        _load(positions, first, count, xyz)
        _corners(xyz, count, scales[level], strides[level], size, index, weight)
        part = grad[level * features : (level + 1) * features, first : first + count]
        if features == 2:
            _scatter_pairs(index, weight, count, part[0], part[1], target)
        else:
            for feature in range(features):
                _scatter_one(index, weight, count, part[feature], target, feature, features)


@jit(parallel=True)
def _scatter(positions, grad, scales, strides, offsets, target, workers):
    """`scatter_level` for all levels; `grad` is [channels, N], `target` the whole table, flat."""
    levels = len(scales)
    features = len(grad) // levels
    for worker in prange(workers):
        # Every workers-th level, because fine levels miss the cache and cost the most.
        for level in range(worker, levels, workers):
            own = target[offsets[level] * features : offsets[level + 1] * features]
            scatter_level(level, positions, grad, scales, strides, offsets, own)
