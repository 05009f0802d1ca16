"""Small networks with numba: some samples and 16 outputs at a time, kept in registers.

All of it is made of `methods.kernels.cpu.tall`. Work is divided among threads by samples, at the
borders of networks. Samples sorted by network lie anywhere in memory, so their rows are prefetched.
"""

import math

import numpy as np
import torch
from numba import prange
from torch import Tensor

from methods.kernels.cpu import (
    LANES,
    TALL,
    arrays,
    check_float32,
    f32,
    jit,
    multiply,
    prefetch,
    prefetch_row,
    tall,
    whole_lanes,
)
from methods.kilonerf.kernels.grouped_mlp import HIDDEN, POSITION_FREQUENCIES, Networks

SLOT = TALL + -TALL % 8  # numbers in a row of `_encode`: `TALL` and a few idle ones, whole vectors

AHEAD = 24  # samples from the one that is computed to the one that is prefetched

DEEP = 96  # samples whose inputs and gradients, with 64 channels, stay in the first-level cache

CHUNKS = 64  # parts into which samples are divided; fixed, so that results are repeatable

RESTART = 5
"""Doublings of an angle before sine and cosine are computed afresh, as each doubles the error."""

ZERO, ONE, TWO = f32(0), f32(1), f32(2)
PER_TURN = f32(2 / math.pi)
# pi / 2 in three parts; the first two have few enough bits that multiples up to 2^11 are exact.
QUARTER0 = f32(1.5703125)
QUARTER1 = f32(0.000483989715576171875)
QUARTER2 = f32(math.pi / 2 - 1.5703125 - 0.000483989715576171875)
# sin r = r + r z (S0 + z (S1 + z S2)), cos r = 1 - z / 2 + z^2 (C0 + z (C1 + z C2)), z = r^2,
# |r| <= pi/4: least-squares fits, errors below 3e-9 before rounding.
S0, S1, S2 = f32(-0.16666655242443085), f32(0.008332165889441967), f32(-0.00019515953317750245)
C0, C1, C2 = f32(0.04166664555668831), f32(-0.0013887342065572739), f32(2.4435852537862957e-05)


def locate(positions: Tensor, cubes: Tensor, corner: Tensor, side: Tensor) -> tuple[Tensor, Tensor]:
    check_float32(positions, corner, side)
    networks = torch.empty(len(positions), dtype=torch.int16)
    local = torch.empty(len(positions), 3)
    _locate(*arrays(positions, cubes, corner), f32(side.item()), *arrays(networks, local))
    return networks, local


def order(networks: Tensor, count: int) -> tuple[Tensor, Tensor]:
    offsets = torch.zeros(count + 1, dtype=torch.int64)
    places = torch.empty(len(networks), dtype=torch.int64)
    _sort(*arrays(networks, offsets, places))
    return places[: int(offsets[-1])], offsets


def encode_frequencies(inputs: Tensor, frequencies: int) -> Tensor:
    check_float32(inputs)
    out = torch.empty(len(inputs), 3 + 6 * frequencies)
    _encode_all(*arrays(inputs), frequencies, out.numpy())
    return out


def grouped_linear(
    inputs: Tensor, weights: Tensor, biases: Tensor, offsets: Tensor, relu: bool
) -> Tensor:
    check_float32(inputs, weights, biases)
    return _Linear.apply(inputs, weights, biases, offsets, relu)


def densities(positions: Tensor, numbers: Tensor, networks: Networks) -> tuple[Tensor, Tensor]:
    layers = *networks["in"], *networks["mid"], *networks["density"]
    check_float32(positions, *layers)
    groups = order(numbers, len(layers[0]))
    raw, geometry = torch.empty(len(positions)), torch.empty(len(positions), HIDDEN + 1)
    if len(groups[0]) < len(positions):
        raw.zero_()
        geometry.zero_()
    given = (tuple(arrays(*part)) for part in ((positions,), layers, groups))
    _densities(*given, POSITION_FREQUENCIES, *arrays(raw, geometry))
    geometry[:, HIDDEN] = numbers
    return raw, geometry


def colours(geometry: Tensor, encoded: Tensor, networks: Networks) -> Tensor:
    layers = *networks["feature"], *networks["direction"], *networks["colour"]
    check_float32(geometry, encoded, *layers)
    groups = order(geometry[:, HIDDEN].int(), len(layers[0]))
    raw = torch.full((len(geometry), 3), -torch.inf)  # whose sigmoid is 0
    _colours(*(tuple(arrays(*part)) for part in ((geometry, encoded), layers, groups)), raw.numpy())
    return raw.sigmoid_()


class _Linear(torch.autograd.Function):
    """Computes outputs and input gradients in whole vectors, and cuts off the excess."""

    @staticmethod
    def forward(ctx, inputs, weights, biases, offsets, relu):
        outputs = weights.shape[2]
        weights, biases = whole_lanes(weights), whole_lanes(biases)
        out = torch.empty(len(inputs), weights.shape[2])
        _linear(*arrays(inputs, weights, biases, offsets), relu, out.numpy())
        ctx.save_for_backward(inputs, weights, offsets, out)
        ctx.relu = relu
        return out[:, :outputs]

    @staticmethod
    def backward(ctx, grad):
        inputs, weights, offsets, out = ctx.saved_tensors
        outputs, wanted = grad.shape[1], ctx.needs_input_grad[0]
        grad = whole_lanes(grad)
        grads = torch.empty(weights.shape), torch.empty(len(weights), out.shape[1])
        channels = inputs.shape[1]
        grad_inputs = torch.empty(len(inputs) if wanted else 0, channels + -channels % LANES)
        given = arrays(inputs, weights, offsets, out, grad)
        _backward(*given, ctx.relu, *arrays(grad_inputs, *grads))
        cut = tuple(part[..., :outputs] for part in grads)
        return grad_inputs[:, :channels] if wanted else None, *cut, None, None


@jit(parallel=True, error_model="numpy")
def _locate(positions, cubes, corner, side, networks, local):
    for s in prange(len(positions)):
        inside = True
        for d in range(3):
            scaled = (positions[s, d] - corner[d]) / side
            cell = np.floor(scaled)
            local[s, d] = TWO * (scaled - cell) - ONE
            inside &= (cell >= ZERO) & (cell < f32(cubes.shape[d]))
        networks[s] = -1
        if inside:
            x = int((positions[s, 0] - corner[0]) / side)
            y = int((positions[s, 1] - corner[1]) / side)
            z = int((positions[s, 2] - corner[2]) / side)
            networks[s] = cubes[x, y, z]


@jit()
def _sort(networks, offsets, places):
    """Counting sort; samples of the same network keep their order."""
    for s in range(len(networks)):
        if networks[s] >= 0:
            offsets[networks[s] + 1] += 1
    for n in range(1, len(offsets)):
        offsets[n] += offsets[n - 1]
    filled = offsets.copy()
    for s in range(len(networks)):
        n = networks[s]
        if n >= 0:
            places[filled[n]] = s
            filled[n] += 1


@jit()
def _borders(offsets):
    """The networks of each of `CHUNKS` parts with about equally many samples; [CHUNKS + 1]."""
    ends = np.empty(CHUNKS + 1, np.int64)
    for chunk in range(CHUNKS):
        ends[chunk] = np.searchsorted(offsets, chunk * offsets[-1] // CHUNKS)
    ends[0], ends[CHUNKS] = 0, len(offsets) - 1
    return ends


@jit(parallel=True)
def _linear(inputs, weights, biases, offsets, relu, out):
    channels, outputs = weights.shape[1:]
    borders = _borders(offsets)
    flat, flat_out = inputs.reshape(-1), out.reshape(-1)
    for chunk in prange(CHUNKS):
        for n in range(borders[chunk], borders[chunk + 1]):
            rows, w, b = offsets[n + 1] - offsets[n], weights[n].reshape(-1), biases[n]
            at, to = offsets[n] * channels, offsets[n] * outputs
            multiply(rows, flat, at, channels, 1, w, outputs, b, flat_out, to, channels, relu)


@jit(parallel=True)
def _backward(inputs, weights, offsets, out, grad, relu, grad_inputs, grad_weights, grad_biases):
    channels, outputs = weights.shape[1:]
    width = grad_inputs.shape[1]
    borders = _borders(offsets)
    flat, flat_inputs = inputs.reshape(-1), grad_inputs.reshape(-1)
    flat_out, flat_grad = out.reshape(-1), grad.reshape(-1)
    for chunk in prange(CHUNKS):
        through = np.empty(DEEP * outputs, np.float32)  # the part of `grad` that passes the ReLU
        turned = np.zeros(outputs * width, np.float32)  # the weights, transposed
        part = np.empty(channels * outputs, np.float32)
        zeros = np.zeros(max(width, outputs), np.float32)
        for n in range(borders[chunk], borders[chunk + 1]):
            of_weights, of_biases = grad_weights[n].reshape(-1), grad_biases[n]
            of_weights[:] = ZERO
            of_biases[:] = ZERO
            if len(grad_inputs) and offsets[n] < offsets[n + 1]:
                for i in range(channels):
                    for o in range(outputs):
                        turned[o * width + i] = weights[n, i, o]
            for first in range(offsets[n], offsets[n + 1], DEEP):
                count = min(DEEP, offsets[n + 1] - first)
                here = slice(first * outputs, (first + count) * outputs)
                shown, given = flat_out[here], flat_grad[here]
                for j in range(count * outputs):
                    through[j] = ZERO if relu and shown[j] <= ZERO else given[j]
                for s in range(count):
                    row = through[s * outputs : (s + 1) * outputs]
                    for o in range(outputs):
                        of_biases[o] += row[o]
                at = first * channels  # inputs^T through
                multiply(
                    channels, flat, at, 1, channels, through, outputs, zeros, part, 0, count, False
                )
                for j in range(len(part)):
                    of_weights[j] += part[j]
                if len(grad_inputs):  # through weights^T
                    to, at = flat_inputs, first * width
                    multiply(
                        count, through, 0, outputs, 1, turned, width, zeros, to, at, outputs, False
                    )


@jit(fastmath={"contract"}, error_model="numpy")
def _sine_and_cosine(angle):
    """Sine and cosine of an angle of up to some thousand quarter turns."""
    whole = np.floor(angle * PER_TURN + f32(0.5))
    r = ((angle - whole * QUARTER0) - whole * QUARTER1) - whole * QUARTER2
    z = r * r
    sine = r + r * z * (S0 + z * (S1 + z * S2))
    cosine = ONE - f32(0.5) * z + z * z * (C0 + z * (C1 + z * C2))
    half = whole - TWO * np.floor(whole * f32(0.5))  # 1 where the two change places
    turns = whole * f32(0.25)
    quarter = whole - f32(4) * np.floor(turns)  # 0, 1, 2, 3
    swapped = half > f32(0.5)
    shown_sine = cosine if swapped else sine
    shown_cosine = sine if swapped else cosine
    down = quarter > f32(1.5)
    left = (quarter > f32(0.5)) & (quarter < f32(2.5))
    return (-shown_sine if down else shown_sine), (-shown_cosine if left else shown_cosine)


@jit(fastmath={"contract"}, error_model="numpy")
def _encode(encoded, frequencies):
    """Fill in sines and cosines: channel c of sample r is encoded[c * SLOT + r], 0 to 2 given."""
    block = 3 * SLOT
    for k in range(frequencies):
        sines, cosines = (1 + 2 * k) * block, (2 + 2 * k) * block
        target_sine = encoded[sines : sines + block]
        target_cosine = encoded[cosines : cosines + block]
        if k % RESTART == 0:
            scale = f32(1 << k)
            for j in range(block):
                target_sine[j], target_cosine[j] = _sine_and_cosine(encoded[j] * scale)
        else:
            before_sine = encoded[sines - 2 * block : sines - block]
            before_cosine = encoded[cosines - 2 * block : cosines - block]
            for j in range(block):
                sine, cosine = before_sine[j], before_cosine[j]
                target_sine[j] = TWO * sine * cosine
                target_cosine[j] = ONE - TWO * sine * sine


@jit(parallel=True)
def _encode_all(inputs, frequencies, out):
    count, channels = out.shape
    blocks = (count + TALL - 1) // TALL
    for chunk in prange(CHUNKS):
        encoded = np.zeros(channels * SLOT, np.float32)
        for block in range(chunk * blocks // CHUNKS, (chunk + 1) * blocks // CHUNKS):
            rows = min(TALL, count - block * TALL)
            for r in range(rows):
                for d in range(3):
                    encoded[d * SLOT + r] = inputs[block * TALL + r, d]
            _encode(encoded, frequencies)
            for r in range(rows):
                for c in range(channels):
                    out[block * TALL + r, c] = encoded[c * SLOT + r]


@jit()
def _block(a, a_row, a_step, w, bias, out, out_row, count, relu):
    """`TALL` rows times w [count, 32], plus bias [32]: out [TALL, 32 of `out_row`]."""
    for left in range(0, HIDDEN, LANES):
        tall(a, 0, a_row, a_step, w, left, HIDDEN, bias, left, out, left, out_row, count, relu)


@jit(parallel=True, fastmath={"contract", "reassoc"})
def _densities(given, layers, groups, frequencies, raw, geometry):
    positions = given[0]
    permutation, offsets = groups
    in_weights, in_biases, mid_weights, mid_biases, density_weights, density_biases = layers
    channels, end = in_weights.shape[1], len(permutation)
    borders = _borders(offsets)
    places, found = positions.reshape(-1), geometry.reshape(-1)
    for chunk in prange(CHUNKS):
        encoded = np.zeros(channels * SLOT, np.float32)
        one, two = np.empty(TALL * HIDDEN, np.float32), np.empty(TALL * HIDDEN, np.float32)
        for n in range(borders[chunk], borders[chunk + 1]):
            into, mid = in_weights[n].reshape(-1), mid_weights[n].reshape(-1)
            weights = density_weights[n].reshape(-1)
            for first in range(offsets[n], offsets[n + 1], TALL):
                rows = min(TALL, offsets[n + 1] - first)  # idle ones repeat what was there
                for r in range(rows):
                    for d in range(3):
                        encoded[d * SLOT + r] = positions[permutation[first + r], d]
                for r in range(first + AHEAD, min(first + AHEAD + TALL, end)):
                    s = permutation[r]
                    prefetch(places, 3 * s)
                    prefetch(raw, s)
                    prefetch_row(found, s * (HIDDEN + 1), HIDDEN + 1)
                _encode(encoded, frequencies)
                _block(encoded, 1, SLOT, into, in_biases[n], one, HIDDEN, channels, True)
                _block(one, HIDDEN, 1, mid, mid_biases[n], two, HIDDEN, HIDDEN, True)
                for r in range(rows):
                    s = permutation[first + r]
                    total = density_biases[n, 0]
                    for i in range(HIDDEN):
                        value = two[r * HIDDEN + i]
                        geometry[s, i] = value
                        total += value * weights[i]
                    raw[s] = total


@jit(parallel=True)
def _colours(given, layers, groups, raw):
    """Colours before the sigmoid."""
    geometry, directions = given
    permutation, offsets = groups
    feature_weights, feature_biases, direction_weights, direction_biases = layers[:4]
    colour_weights, colour_biases = layers[4:]
    seen = directions.shape[1]
    channels, end = HIDDEN + seen, len(permutation)
    borders = _borders(offsets)
    hidden, towards, shown = geometry.reshape(-1), directions.reshape(-1), raw.reshape(-1)
    for chunk in prange(CHUNKS):
        given = np.zeros(TALL * HIDDEN, np.float32)
        joined = np.zeros(TALL * channels, np.float32)
        inner = np.empty(TALL * HIDDEN, np.float32)
        last, bias = np.zeros(HIDDEN * LANES, np.float32), np.zeros(LANES, np.float32)
        result = np.empty(TALL * LANES, np.float32)
        for n in range(borders[chunk], borders[chunk + 1]):
            if offsets[n] == offsets[n + 1]:
                continue
            feature, direction = feature_weights[n].reshape(-1), direction_weights[n].reshape(-1)
            for c in range(3):
                bias[c] = colour_biases[n, c]
                for i in range(HIDDEN):
                    last[i * LANES + c] = colour_weights[n, i, c]
            for first in range(offsets[n], offsets[n + 1], TALL):
                rows = min(TALL, offsets[n + 1] - first)  # idle ones repeat what was there
                for r in range(rows):
                    s = permutation[first + r]
                    for i in range(HIDDEN):
                        given[r * HIDDEN + i] = geometry[s, i]
                    for i in range(seen):
                        joined[r * channels + HIDDEN + i] = directions[s, i]
                for r in range(first + AHEAD, min(first + AHEAD + TALL, end)):
                    s = permutation[r]
                    prefetch_row(hidden, s * (HIDDEN + 1), HIDDEN + 1)
                    prefetch_row(towards, s * seen, seen)
                    prefetch(shown, 3 * s)
                of_feature, of_direction = feature_biases[n], direction_biases[n]
                _block(given, HIDDEN, 1, feature, of_feature, joined, channels, HIDDEN, False)
                _block(joined, channels, 1, direction, of_direction, inner, HIDDEN, channels, True)
                tall(inner, 0, HIDDEN, 1, last, 0, LANES, bias, 0, result, 0, LANES, HIDDEN, False)
                for r in range(rows):
                    for c in range(3):
                        raw[permutation[first + r], c] = result[r * LANES + c]
