"""A small network with numba: `DEEP` samples go through all layers before the next ones do.

bfloat16 goes layer by layer instead: a CPU that has products of bfloat16 computes them faster than
any product of float32.
"""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numba import prange
from torch import Tensor
from torch.nn import functional

from methods.kernels.cpu import LANES, check_float32, f32, flat, jit, multiply, u64
from methods.kernels.mlp.reference import layer_by_layer

DEEP = 96  # samples whose activations, with 64 channels, stay in the first-level cache

CHUNKS = 64  # parts into which samples are divided; fixed, so that results are repeatable

ZERO = f32(0)

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
    left = inputs[0]
    right = inputs[1] if len(inputs) > 1 else left.new_empty(len(left), 0)
    if not (torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)):
        return _outputs(left, right, weights, learning=False)[0]
    return _Mlp.apply(left, right, *weights)


def _outputs(
    left: Tensor, right: Tensor, weights: Sequence[Tensor], *, learning: bool
) -> tuple[Tensor, Tensor]:
    """Outputs [S, O_n], and the hidden activations if they are needed to learn."""
    widths = [left.shape[1] + right.shape[1], *map(len, weights)]
    kept = torch.empty(len(left) * sum(map(_padded, widths[1:-1])) if learning else 0)
    out = torch.empty(len(left), widths[-1])
    given, joined = flat(left, right), flat(_joined(weights, turned=False))
    _forward(*given, left.shape[1], *joined, *_sizes(widths), *flat(kept, out))
    return out, kept


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, left, right, *weights):
        out, kept = _outputs(left, right, weights, learning=True)
        ctx.save_for_backward(left, right, kept, *weights)
        return out

    @staticmethod
    def backward(ctx, grad):
        left, right, kept, *weights = ctx.saved_tensors
        widths = [left.shape[1] + right.shape[1], *map(len, weights)]
        turned = _joined(weights, turned=True)
        of_weights = torch.zeros(CHUNKS, len(turned))
        wanted = any(ctx.needs_input_grad[:2])
        of_inputs = [x.new_empty(x.shape if wanted else 0) for x in (left, right)]
        given, results = flat(left, right), [*flat(kept, grad, *of_inputs), of_weights.numpy()]
        _backward(*given, left.shape[1], *flat(turned), *_sizes(widths), *results)
        shapes = [(_padded(i), _padded(o)) for i, o in pairwise(widths)]
        parts = of_weights.sum(dim=0).split([i * o for i, o in shapes])
        of_layers = [
            part.view(shape)[: layer.shape[1], : len(layer)].T
            for part, shape, layer in zip(parts, shapes, weights, strict=True)
        ]
        return *(of_inputs if wanted else (None, None)), *of_layers


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


def _padded(width: int) -> int:
    """`width` filled up to whole vectors."""
    return width + -width % LANES


def _sizes(widths: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """The widths, and the same filled up to whole vectors."""
    return np.array(widths), np.array([_padded(width) for width in widths])


def _joined(weights: Sequence[Tensor], *, turned: bool) -> Tensor:
    """All layers in one flat tensor, each [I, O] or, turned, [O, I], in whole vectors."""
    parts = []
    for layer in weights:
        outputs, inputs = layer.shape
        full = functional.pad(layer.detach(), (0, -inputs % LANES, 0, -outputs % LANES))
        parts.append((full if turned else full.T).reshape(-1))
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
def _forward(left, right, a, weights, widths, sizes, kept, out):
    """`kept` [layers - 1, S, outputs] is filled with the hidden activations, unless it is empty.

    All arrays are flat; `left` has `a` channels.
    """
    b, outputs, layers = widths[0] - a, widths[-1], len(widths) - 1
    count = len(out) // outputs
    blocks = (count + DEEP - 1) // DEEP
    last = sizes[-1]
    for chunk in prange(CHUNKS):
        begin, end = chunk * blocks // CHUNKS, (chunk + 1) * blocks // CHUNKS
        if begin == end:
            continue
        given = np.zeros(DEEP * sizes[0], np.float32)
        inner = np.empty(0 if len(kept) else DEEP * sum(sizes[1:-1]), np.float32)
        result = np.empty(DEEP * last, np.float32)
        nothing = np.zeros(max(sizes), np.float32)
        for block in range(begin, end):
            first = block * DEEP
            rows = min(DEEP, count - first)
            _copy(rows, a, left, first * a, a, given, 0, sizes[0])
            _copy(rows, b, right, first * b, b, given, a, sizes[0])
            x, x_at, w_at, before = given, 0, 0, 0
            for layer in range(layers):
                i, o = sizes[layer], sizes[layer + 1]
                w = weights[w_at : w_at + i * o]
                w_at += i * o
                if layer == layers - 1:
                    multiply(rows, x, x_at, i, 1, w, o, nothing, result, 0, i, False)
                elif len(kept):
                    at = before * count + first * o
                    multiply(rows, x, x_at, i, 1, w, o, nothing, kept, at, i, True)
                    x, x_at = kept, at
                else:
                    at = before * DEEP
                    multiply(rows, x, x_at, i, 1, w, o, nothing, inner, at, i, True)
                    x, x_at = inner, at
                before += o
            _copy(rows, outputs, result, 0, last, out, first * outputs, outputs)


@jit(parallel=True, error_model="numpy")
def _backward(left, right, a, turned, widths, sizes, kept, grad, of_left, of_right, of_weights):
    """`of_weights` [CHUNKS, all weights] is added to; `of_left`, `of_right` may be empty."""
    b, outputs, layers = widths[0] - a, widths[-1], len(widths) - 1
    count = len(grad) // outputs
    blocks = (count + DEEP - 1) // DEEP
    widest, last = max(sizes), sizes[-1]
    for chunk in prange(CHUNKS):
        begin, end = chunk * blocks // CHUNKS, (chunk + 1) * blocks // CHUNKS
        if begin == end:
            continue
        given = np.zeros(DEEP * sizes[0], np.float32)
        above, below = np.empty(DEEP * widest, np.float32), np.empty(DEEP * widest, np.float32)
        part = np.empty(widest * widest, np.float32)
        nothing = np.zeros(widest, np.float32)
        sums = of_weights[chunk]
        for block in range(begin, end):
            first = block * DEEP
            rows = min(DEEP, count - first)
            _copy(rows, a, left, first * a, a, given, 0, sizes[0])
            _copy(rows, b, right, first * b, b, given, a, sizes[0])
            above[: rows * last] = ZERO
            _copy(rows, outputs, grad, first * outputs, outputs, above, 0, last)
            w_end, before = len(turned), sum(sizes[1:-1])
            for layer in range(layers - 1, -1, -1):
                i, o = sizes[layer], sizes[layer + 1]
                w_at = w_end - i * o
                if layer:
                    before -= i
                    x, x_at = kept, before * count + first * i
                else:
                    x, x_at = given, 0
                multiply(i, x, x_at, 1, i, above, o, nothing, part, 0, rows, False)  # x^T above
                total = sums[w_at:w_end]
                for j in range(len(total)):
                    total[j] += part[j]
                if layer or len(of_left):
                    w = turned[w_at:w_end]
                    multiply(
                        rows, above, 0, o, 1, w, i, nothing, below, 0, widths[layer + 1], False
                    )
                    if layer:  # the gradient passes where the ReLU's result is not 0
                        shown = x[x_at : x_at + rows * i]
                        for j in range(len(shown)):
                            below[j] = ZERO if shown[j] == ZERO else below[j]
                    above, below = below, above
                w_end = w_at
            if len(of_left):
                _copy(rows, a, above, 0, sizes[0], of_left, first * a, a)
                _copy(rows, b, above, a, sizes[0], of_right, first * b, b)
