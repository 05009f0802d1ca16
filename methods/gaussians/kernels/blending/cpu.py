"""Blending with numba: tiles of 16 x 16 pixels, processed row by row.

Gaussians are sorted by depth once. Each tile gets the list of Gaussians whose boxes touch it, in
this order, and processes the list until it is opaque. The 16 pixels of a row are the lanes of a
vector: the code has no branches, and exp is a polynomial.
"""

import math

import numba
import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.gaussians.kernels.blending import LARGEST_ALPHA
from methods.gaussians.kernels.projection import LEAST_ALPHA, Ellipses
from methods.kernels.cpu import arrays, check_float32, f32, i32, jit
from methods.kernels.types import Pixels

TILE = 16  # pixels, along both axes
PIXELS = TILE * TILE
PATIENCE = 8  # Gaussians between two checks whether a tile is opaque

FIELDS = 10  # of a packed Gaussian: u, v, A, B, C, opacity, r, g, b, z
SUMS = 9  # of a Gaussian in a tile: see `_tile_backward`
IN_LANES = 6 * PIXELS  # offset of these sums in the state of a tile, one per lane
LANES = {"contract", "nsz", "arcp"}
"""Fast-math flags that leave the compiler only one possible result; see `methods.kernels.cpu`."""

LARGEST, LEAST = f32(LARGEST_ALPHA), f32(LEAST_ALPHA)
ZERO, ONE, HALF = f32(0), f32(1), f32(0.5)
LOG2_E = f32(math.log2(math.e))
# 2^x on [0, 1], least-squares fit of the relative error: below 2e-9 before rounding.
P0, P1, P2 = f32(1.000000001815494), f32(0.693146987057476), f32(0.24022979581422)
P3, P4 = f32(0.05548352472), f32(0.009678472554120963)
P5, P6 = f32(0.001244308151184), f32(0.000216906091570)


def blend(
    ellipses: Ellipses, opacities: Tensor, colours: Tensor, width: int, height: int, stop: float
) -> Pixels:
    given = ellipses.centres, ellipses.conics, opacities, colours
    check_float32(*given)
    return Pixels(*_Blend.apply(*given, ellipses.depth, ellipses.extents, width, height, stop))


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(ctx, centres, conics, opacities, colours, depth, extents, width, height, stop):
        given = arrays(centres, conics, opacities, colours, depth, extents)
        order = _by_depth(*given[4:])
        packed = np.empty((len(order), FIELDS), np.float32)
        boxes = np.empty((len(order), 4), np.int32)
        _pack(order, *given, width, height, packed, boxes)
        lists = _lists(boxes, width, height)
        pixels = Pixels.blank(width * height, 3)
        out = arrays(*(x.view(height, width, *x.shape[1:]) for x in pixels.columns))
        _forward(packed, boxes, *lists[:2], f32(stop), numba.get_num_threads(), *out)
        ctx.save_for_backward(pixels.values, pixels.alpha)
        ctx.gaussians, ctx.lists = (order, packed, boxes), lists
        ctx.size, ctx.stop, ctx.count = (height, width), stop, len(depth)
        ctx.mark_non_differentiable(pixels.depth_sum)
        return pixels.columns

    @staticmethod
    def backward(ctx, grad_values, _grad_depth, grad_alpha):
        values, alpha = ctx.saved_tensors
        (order, packed, boxes), (offsets, ranks, first, slots) = ctx.gaussians, ctx.lists
        grad = torch.cat((grad_values, grad_alpha[:, None]), dim=1)  # [P, 4]
        gain = (grad_values * values).sum(dim=1) + grad_alpha * alpha
        sums = np.empty((len(ranks), SUMS), np.float32)
        light = grad.numpy().reshape(*ctx.size, 4), gain.numpy().reshape(ctx.size)
        how = f32(ctx.stop), numba.get_num_threads()
        _backward(packed, boxes, offsets, ranks, *how, *light, sums)
        grads = [torch.zeros(ctx.count, n) for n in (2, 3, 1, 3)]
        _collect(order, packed, first, slots, sums, *arrays(*grads))
        centres, conics, opacities, colours = grads
        return centres, conics, opacities.squeeze(1), colours, None, None, None, None, None


def _by_depth(depth: np.ndarray, extents: np.ndarray) -> np.ndarray:
    """Indices [n] of the visible Gaussians, nearest first. Depths are positive, so their bits as
    integers have the same order; with the index below them, a fast sort is stable."""
    shown = (extents[:, 0] > 0).nonzero()[0]
    keys = depth[shown].view(np.int32).astype(np.int64) << 32 | shown
    keys.sort()
    return keys & 0xFFFFFFFF


def _lists(boxes: np.ndarray, width: int, height: int) -> tuple[np.ndarray, ...]:
    """Which Gaussians each tile shows: offsets, ranks, first and slots. Tile t owns entries
    offsets[t] to offsets[t + 1] of ranks: Gaussians by depth, ascending. That of rank r owns
    first[r] to first[r + 1] of slots: the indices of its entries, tile by tile."""
    across, down = -(-width // TILE), -(-height // TILE)
    threads = numba.get_num_threads()
    counts, first = np.zeros(across * down, np.int64), np.zeros(len(boxes) + 1, np.int64)
    _count(boxes, across, threads, counts, first)
    offsets, first = np.concatenate(([0], counts.cumsum())), first.cumsum()
    ranks, slots = np.empty((2, offsets[-1]), np.int32)
    _fill(boxes, across, threads, offsets[:-1].copy(), first, ranks, slots)
    return offsets, ranks, first, slots


@jit(parallel=True)
def _pack(order, centres, conics, opacities, colours, depth, extents, width, height, packed, boxes):
    """Pack Gaussians in depth order, and the pixel box of each: [left, right), [top, bottom)."""
    for rank in prange(len(order)):
        i = order[rank]
        u, v = centres[i, 0], centres[i, 1]
        row = packed[rank]
        row[0], row[1] = u, v
        row[2], row[3], row[4] = conics[i, 0], conics[i, 1], conics[i, 2]
        row[5] = opacities[i]
        row[6], row[7], row[8] = colours[i, 0], colours[i, 1], colours[i, 2]
        row[9] = depth[i]
        box = boxes[rank]
        box[0], box[1], box[2], box[3] = 0, 0, 0, 0
        # A little larger, so that rounding never leaves out a pixel.
        half, tall = extents[i, 0] * f32(1.0001), extents[i, 1] * f32(1.0001)
        left, right = max(u - half - HALF, ZERO), min(u + half + HALF, f32(width))
        top, bottom = max(v - tall - HALF, ZERO), min(v + tall + HALF, f32(height))
        if extents[i, 0] > ZERO and left < right and top < bottom:
            box[0], box[1] = i32(math.floor(left)), i32(math.ceil(right))
            box[2], box[3] = i32(math.floor(top)), i32(math.ceil(bottom))


@jit()
def _tiles(box):
    """The tiles [left, right) x [top, bottom) that a box of pixels touches."""
    if box[1] <= box[0]:
        return 0, 0, 0, 0
    last = TILE - 1
    return box[0] // TILE, (box[1] + last) // TILE, box[2] // TILE, (box[3] + last) // TILE


@jit(parallel=True)
def _count(boxes, across, threads, counts, entries):
    """Count the entries of each tile and of each Gaussian (shifted by one); each of n threads has
    every n-th row of tiles."""
    for thread in prange(threads):
        for rank in range(len(boxes)):
            left, right, top, bottom = _tiles(boxes[rank])
            if thread == 0:
                entries[rank + 1] = (right - left) * (bottom - top)
            for row in range(top + (thread - top) % threads, bottom, threads):
                for column in range(left, right):
                    counts[row * across + column] += 1


@jit(parallel=True)
def _fill(boxes, across, threads, filled, first, ranks, slots):
    for thread in prange(threads):
        for rank in range(len(boxes)):
            left, right, top, bottom = _tiles(boxes[rank])
            for row in range(top + (thread - top) % threads, bottom, threads):
                slot = first[rank] + (row - top) * (right - left)
                for column in range(left, right):
                    tile = row * across + column
                    entry = filled[tile]
                    filled[tile] = entry + 1
                    ranks[entry] = rank
                    slots[slot + column - left] = entry


@jit(fastmath=LANES)
def _exp(x):
    """e^x for x <= 0, relative error of a few roundings; 2^-126 below that."""
    y = max(x * LOG2_E, f32(-126))
    whole = np.floor(y)
    f = y - whole
    power = P0 + f * (P1 + f * (P2 + f * (P3 + f * (P4 + f * (P5 + f * P6)))))
    return power * i32((i32(whole) + i32(127)) << i32(23)).view(np.float32)


@jit(parallel=True)
def _forward(packed, boxes, offsets, ranks, stop, threads, values, depth, alpha):
    height, width = alpha.shape
    across = -(-width // TILE)
    tiles = len(offsets) - 1
    for thread in prange(threads):
        state = np.empty(5 * PIXELS, np.float32)
        for tile in range(thread, tiles, threads):
            if offsets[tile] == offsets[tile + 1]:
                continue
            top, left = tile // across * TILE, tile % across * TILE
            own = ranks[offsets[tile] : offsets[tile + 1]]
            _tile_forward(packed, boxes, own, stop, top, left, state)
            for row in range(top, min(top + TILE, height)):
                for column in range(left, min(left + TILE, width)):
                    at = (row - top) * TILE + column - left
                    for k in range(3):
                        values[row, column, k] = state[(1 + k) * PIXELS + at]
                    depth[row, column] = state[4 * PIXELS + at]
                    alpha[row, column] = ONE - state[at]


@jit(fastmath=LANES)
def _tile_forward(packed, boxes, ranks, stop, top, left, state):
    """`state`: transmittance, r, g, b and depth sum of each pixel of the tile."""
    state[:PIXELS] = ONE
    state[PIXELS:] = ZERO
    for n in range(len(ranks)):
        if n % PATIENCE == 0 and _largest(state) <= stop:
            break
        rank = ranks[n]
        u, v = packed[rank, 0] - f32(left), packed[rank, 1] - f32(top)
        a, b, c = packed[rank, 2], packed[rank, 3], packed[rank, 4]
        opacity = packed[rank, 5]
        red, green, blue, z = packed[rank, 6], packed[rank, 7], packed[rank, 8], packed[rank, 9]
        for row in range(max(boxes[rank, 2] - top, 0), min(boxes[rank, 3] - top, TILE)):
            y = f32(row) + HALF - v
            for lane in range(TILE):
                at = np.uint64(row * TILE) + np.uint64(lane)
                x = f32(lane) + HALF - u
                distance = a * x * x + (b + b) * x * y + c * y * y
                share = min(opacity * _exp(-HALF * distance), LARGEST)
                transmittance = state[at]
                shown = (share >= LEAST) & (transmittance > stop)
                weight = transmittance * share if shown else ZERO
                state[at] = transmittance - weight
                state[at + np.uint64(PIXELS)] += weight * red
                state[at + np.uint64(2 * PIXELS)] += weight * green
                state[at + np.uint64(3 * PIXELS)] += weight * blue
                state[at + np.uint64(4 * PIXELS)] += weight * z


@jit(fastmath=LANES)
def _largest(state):
    largest = ZERO
    for at in range(PIXELS):
        largest = max(largest, state[at])
    return largest


@jit(parallel=True)
def _backward(packed, boxes, offsets, ranks, stop, threads, grad, gain, sums):
    height, width = gain.shape
    across = -(-width // TILE)
    tiles = len(offsets) - 1
    for thread in prange(threads):
        state = np.empty(IN_LANES + SUMS * TILE, np.float32)
        for tile in range(thread, tiles, threads):
            if offsets[tile] == offsets[tile + 1]:
                continue
            top, left = tile // across * TILE, tile % across * TILE
            state[:PIXELS] = ONE
            state[PIXELS:] = ZERO
            for row in range(top, min(top + TILE, height)):
                for column in range(left, min(left + TILE, width)):
                    at = (row - top) * TILE + column - left
                    state[PIXELS + at] = gain[row, column]
                    for k in range(4):
                        state[(2 + k) * PIXELS + at] = grad[row, column, k]
            first, end = offsets[tile], offsets[tile + 1]
            own, total = ranks[first:end], sums[first:end]
            _tile_backward(packed, boxes, own, stop, top, left, state, total)


@jit(error_model="numpy")  # saves a branch at the division
def _tile_backward(packed, boxes, ranks, stop, top, left, state, sums):
    """With g_i = dL/dw_i: dL/dalpha_i = T_i g_i - (sum_{j > i} w_j g_j) / (1 - alpha_i).

    `state`: transmittance, the sum behind, dL/dr, dL/dg, dL/db and dL/dalpha of each pixel; then
    the sums of one Gaussian, per lane.
    `sums` of each Gaussian, with p = alpha_i dL/dalpha_i = dL/d(exponent):
    p, p x, p y, p x^2, p x y, p y^2, dL/dr, dL/dg, dL/db.
    """
    for n in range(len(ranks)):
        sums[n] = ZERO
    for n in range(len(ranks)):
        if n % PATIENCE == 0 and _largest(state) <= stop:
            break
        rank = ranks[n]
        u, v = packed[rank, 0] - f32(left), packed[rank, 1] - f32(top)
        a, b, c = packed[rank, 2], packed[rank, 3], packed[rank, 4]
        opacity = packed[rank, 5]
        red, green, blue = packed[rank, 6], packed[rank, 7], packed[rank, 8]
        state[IN_LANES:] = ZERO
        for row in range(max(boxes[rank, 2] - top, 0), min(boxes[rank, 3] - top, TILE)):
            y = f32(row) + HALF - v
            for lane in range(TILE):
                at = np.uint64(row * TILE) + np.uint64(lane)
                x = f32(lane) + HALF - u
                distance = a * x * x + (b + b) * x * y + c * y * y
                raw = opacity * _exp(-HALF * distance)
                share = min(raw, LARGEST)
                transmittance = state[at]
                shown = (share >= LEAST) & (transmittance > stop)
                weight = transmittance * share if shown else ZERO
                to_red = state[at + np.uint64(2 * PIXELS)]
                to_green = state[at + np.uint64(3 * PIXELS)]
                to_blue = state[at + np.uint64(4 * PIXELS)]
                to_alpha = state[at + np.uint64(5 * PIXELS)]
                gain = to_red * red + to_green * green + to_blue * blue + to_alpha
                behind = state[at + np.uint64(PIXELS)] - weight * gain
                state[at] = transmittance - weight
                state[at + np.uint64(PIXELS)] = behind
                slope = transmittance * gain - behind / (ONE - share)
                p = raw * slope if shown & (raw < LARGEST) else ZERO
                px, py = p * x, p * y
                own = np.uint64(IN_LANES) + np.uint64(lane)
                state[own] += p
                state[own + np.uint64(TILE)] += px
                state[own + np.uint64(2 * TILE)] += py
                state[own + np.uint64(3 * TILE)] += px * x
                state[own + np.uint64(4 * TILE)] += px * y
                state[own + np.uint64(5 * TILE)] += py * y
                state[own + np.uint64(6 * TILE)] += weight * to_red
                state[own + np.uint64(7 * TILE)] += weight * to_green
                state[own + np.uint64(8 * TILE)] += weight * to_blue
        for k in range(SUMS):
            for lane in range(TILE):
                sums[n, k] += state[IN_LANES + k * TILE + lane]


@jit(parallel=True)
def _collect(order, packed, first, slots, sums, centres, conics, opacities, colours):
    """Compute the gradients of each Gaussian from its sums in all tiles."""
    for rank in prange(len(order)):
        total = np.zeros(SUMS, np.float32)
        for slot in range(first[rank], first[rank + 1]):
            for k in range(SUMS):
                total[k] += sums[slots[slot], k]
        a, b, c = packed[rank, 2], packed[rank, 3], packed[rank, 4]
        i = order[rank]
        centres[i, 0] = a * total[1] + b * total[2]
        centres[i, 1] = b * total[1] + c * total[2]
        conics[i, 0] = -HALF * total[3]
        conics[i, 1] = -total[4]
        conics[i, 2] = -HALF * total[5]
        opacities[i, 0] = total[0] / packed[rank, 5] if packed[rank, 5] > ZERO else ZERO
        colours[i, 0], colours[i, 1], colours[i, 2] = total[6], total[7], total[8]
