"""A small network with numba: `DEEP` samples go through all layers before the next ones do.

Whoever asks for gradients, or gives bfloat16, gets products by torch, layer by layer: these are
nearly as fast, or faster on a CPU that has products of bfloat16.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.nn import functional

from methods.kernels.cpu import LANES, check_float32, flat, jit, multiply, u64
from methods.kernels.mlp.reference import layer_by_layer

DEEP = 96  # samples whose activations, with 64 channels, stay in the first-level cache

CHUNKS = 64  # parts into which samples are divided; fixed, so that results are repeatable

RELU_CHUNK = 1 << 14  # numbers that a thread takes at a time

MINUS_INFINITY = np.int16(-128)
"""The bits of -inf in bfloat16 as a whole number. All negative numbers are at or below it, negative
NaNs above."""

NOTHING = np.int16(0)


def mlp(inputs: Sequence[Tensor], weights: Sequence[Tensor]) -> Tensor:
    tensors = *inputs, *weights
    if all(tensor.dtype == torch.bfloat16 for tensor in tensors):
        return layer_by_layer(inputs, weights, _Relu.apply)
    check_float32(*tensors)
    if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors):
        return layer_by_layer(inputs, weights, Tensor.relu_)
    left = inputs[0]
    right = inputs[1] if len(inputs) > 1 else left.new_empty(len(left), 0)
    widths = np.array([left.shape[1] + right.shape[1], *map(len, weights)])
    out = torch.empty(len(left), widths[-1])
    _forward(*flat(left, right), left.shape[1], *flat(_joined(weights)), widths, *flat(out))
    return out


class _Relu(torch.autograd.Function):
    """ReLU in place of bfloat16, by its bits, at the speed of memory: torch widens to float32 and
    rounds again, which takes four times as long. NaN stays NaN."""

    @staticmethod
    def forward(ctx, x):
        _rectify(_bits(x))
        ctx.mark_dirty(x)
        ctx.save_for_backward(x)
        return x

    @staticmethod
    def backward(ctx, grad):
        (out,) = ctx.saved_tensors
        grad = grad.contiguous()
        passed = torch.empty_like(grad)
        _pass_on(_bits(out), _bits(grad), _bits(passed))
        return passed


def _bits(x: Tensor) -> np.ndarray:
    return x.detach().view(torch.int16).view(-1).numpy()


def _joined(weights: Sequence[Tensor]) -> Tensor:
    """All layers in one flat tensor, each [I, O] in whole vectors."""
    parts = []
    for layer in weights:
        outputs, inputs = layer.shape
        full = functional.pad(layer.detach(), (0, -inputs % LANES, 0, -outputs % LANES))
        parts.append(full.T.reshape(-1))
    return torch.cat(parts)


@jit(parallel=True)
def _rectify(x):
    for chunk in prange((len(x) + RELU_CHUNK - 1) // RELU_CHUNK):
        part = x[chunk * RELU_CHUNK : (chunk + 1) * RELU_CHUNK]
        for i in range(len(part)):
            part[i] = NOTHING if part[i] <= MINUS_INFINITY else part[i]


@jit(parallel=True)
def _pass_on(out, grad, passed):
    for chunk in prange((len(out) + RELU_CHUNK - 1) // RELU_CHUNK):
        here = slice(chunk * RELU_CHUNK, (chunk + 1) * RELU_CHUNK)
        shown, given, kept = out[here], grad[here], passed[here]
        for i in range(len(shown)):
            kept[i] = NOTHING if shown[i] == NOTHING else given[i]


@jit(error_model="numpy")
def _copy(rows, width, source, at, source_row, target, to, target_row):
    """Copy `rows` rows of `width` numbers between flat arrays."""
    for r in range(rows):
        a, b = u64(at + r * source_row), u64(to + r * target_row)
        for i in range(width):
            target[b + u64(i)] = source[a + u64(i)]


@jit(parallel=True, error_model="numpy")
def _forward(left, right, a, weights, widths, out):
    """All arrays are flat but `widths`, of the input and each layer; `left` has `a` channels."""
    b, outputs, layers = widths[0] - a, widths[-1], len(widths) - 1
    sizes = (widths + LANES - 1) // LANES * LANES  # whole vectors
    count = len(out) // outputs
    blocks = (count + DEEP - 1) // DEEP
    last = sizes[-1]
    for chunk in prange(CHUNKS):
        begin, end = chunk * blocks // CHUNKS, (chunk + 1) * blocks // CHUNKS
        if begin == end:
            continue
        given = np.zeros(DEEP * sizes[0], np.float32)
        inner = np.empty(DEEP * sum(sizes[1:-1]), np.float32)
        result = np.empty(DEEP * last, np.float32)
        nothing = np.zeros(max(sizes), np.float32)
        for block in range(begin, end):
            first = block * DEEP
            rows = min(DEEP, count - first)
            _copy(rows, a, left, first * a, a, given, 0, sizes[0])
            _copy(rows, b, right, first * b, b, given, a, sizes[0])
            x, x_at, w_at, to = given, 0, 0, 0
            for layer in range(layers):
                i, o = sizes[layer], sizes[layer + 1]
                w = weights[w_at : w_at + i * o]
                w_at += i * o
                if layer == layers - 1:
                    multiply(rows, x, x_at, i, 1, w, o, nothing, result, 0, i, False)
                else:
                    multiply(rows, x, x_at, i, 1, w, o, nothing, inner, to, i, True)
                    x, x_at = inner, to
                to += DEEP * o
            _copy(rows, outputs, result, 0, last, out, first * outputs, outputs)
