"""Convolution by Winograd's minimal filtering, F(4 x 4, 3 x 3), with numba.

A tile of 6 x 6 pixels d gives 4 x 4 pixels of the result (Lavin & Gray 2016, Eq. 8 and Section
4.3): A^T [(G g G^T) . (B^T d B)] A. The product in the middle is one of numbers, 36 for 16 pixels
where the sum over 3 x 3 pixels needs 144; over all channels it becomes 36 matrix products. Channels
lie last and are computed `LANES` at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from torch import Tensor
from torch.nn import functional

from methods.kernels.cpu import LANES, check_float32, f32, flat, jit, multiply
from methods.steernerf.kernels.convolution import reference
from methods.steernerf.kernels.spans import Spans, ends

TILES = 48  # tiles of a row that go together: with 16 channels, their numbers fit the L2 cache

G24 = torch.tensor(
    [[6, 0, 0], [-4, -4, -4], [-4, 4, -4], [1, 2, 4], [1, -2, 4], [0, 0, 24]], dtype=torch.float64
)
"""24 G, in whole numbers."""

BOTH = torch.kron(G24, G24)
"""24^2 G g G^T: from 9 taps to 36 numbers."""

SHARES = 8  # of the tiles, summed apart from each other

GOLDEN = (math.sqrt(5) - 1) / 2
"""Steps of this share of a row of things visit all parts of it alike."""

NOTHING = torch.empty(0)


def convolution(
    parts: Sequence[Tensor],
    weight: Tensor,
    bias: Tensor,
    plus: Tensor | None,
    relu: bool,
    shuffle: bool,
    spans: Spans | None,
) -> Tensor:
    given = [*parts, weight, bias, *([] if plus is None else [plus])]
    learns = torch.is_grad_enabled() and any(x.requires_grad for x in given)
    half = torch.is_autocast_enabled("cpu") or all(x.dtype == torch.bfloat16 for x in parts)
    if half or (learns and spans is not None):
        return reference.convolution(parts, weight, bias, plus, relu, shuffle, spans)
    check_float32(*given)
    if learns:
        return _Convolution.apply(relu, shuffle, weight, bias, plus, *parts)
    return _computed(parts, weight, bias, plus, relu, shuffle, spans)


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, relu, shuffle, weight, bias, plus, *parts):
        out = _computed(parts, weight, bias, plus, relu, shuffle, None)
        ctx.shuffle = shuffle
        ctx.save_for_backward(out if relu else None, weight, *parts)
        return out

    @staticmethod
    def backward(ctx, grad):
        out, weight, *parts = ctx.saved_tensors
        _, _, *learns = ctx.needs_input_grad
        if out is not None:
            grad = torch.ops.aten.threshold_backward(grad, out, 0)
        if ctx.shuffle:  # one pixel of each 2 x 2 after the other, as `_by_pixel` orders channels
            four = [grad[..., row::2, column::2] for row in (0, 1) for column in (0, 1)]
            grad, weight = torch.cat(four, dim=1), _by_pixel(weight)
        of_weight = torch.cat([_of_taps(part, grad) for part in parts], 1) if learns[0] else None
        of_bias = grad.sum((0, 2, 3)) if learns[1] else None
        if ctx.shuffle:
            of_weight, of_bias = (x if x is None else _by_channel(x) for x in (of_weight, of_bias))
        of_parts, none = [], (None, False, False, None)
        of_each = weight.split([part.shape[1] for part in parts], dim=1)
        for taps, wanted in zip(of_each, learns[3:], strict=True):
            back = taps.transpose(0, 1).flip(2, 3)
            found = _computed([grad], back, back.new_zeros(len(back)), *none) if wanted else None
            of_parts.append(found)
        return None, None, of_weight, of_bias, grad if learns[2] else None, *of_parts


def _computed(
    parts: Sequence[Tensor],
    weight: Tensor,
    bias: Tensor,
    plus: Tensor | None,
    relu: bool,
    shuffle: bool,
    spans: Spans | None,
) -> Tensor:
    pictures, outputs = [_last(part) for part in parts], len(weight)
    batch, height, width, _ = pictures[0].shape
    together = shuffle and outputs % (4 * LANES) == 0  # a vector goes to one pixel
    if together:  # the channels that go to one pixel lie side by side
        weight, bias = _by_pixel(weight), _by_pixel(bias)
        out = torch.empty(batch, 2 * height, 2 * width, outputs // 4)
    else:
        out = torch.empty(batch, height, width, outputs)
    channels = [x.shape[3] for x in pictures] + [0] * (2 - len(pictures))
    padded = outputs + -outputs % LANES
    _convolve(
        *flat(pictures[0], pictures[1] if len(pictures) > 1 else NOTHING),
        *(*channels, batch, height, width, _stride(batch * -(-height // 4))),
        ends(spans, height, width).numpy(),
        *flat(_transformed(weight, [x.shape[1] for x in parts], channels, padded)),
        *flat(functional.pad(bias, (0, padded - outputs))),
        *(padded, outputs, relu, plus is not None, together),
        *flat(NOTHING if plus is None else plus.permute(0, 2, 3, 1), out),
    )
    result = out.permute(0, 3, 1, 2)
    return functional.pixel_shuffle(result, 2) if shuffle and not together else result


def halved(pictures: Tensor, spans: Spans | None) -> Tensor:
    learns = torch.is_grad_enabled() and pictures.requires_grad
    if pictures.dtype != torch.float32 or learns:
        return reference.halved(pictures, spans)
    batch, channels, height, width = pictures.shape
    out = torch.empty(batch, height // 2, width // 2, channels)
    given = pictures.permute(0, 2, 3, 1).contiguous()
    of_rows = ends(spans, height, width).numpy()
    _halve(given.flatten(0, 1).numpy(), out.flatten(0, 1).numpy(), of_rows)
    return out.permute(0, 3, 1, 2)


def _by_pixel(x: Tensor) -> Tensor:
    """The outputs of a shuffled convolution, of which four follow each other on 2 x 2 pixels, in
    another order: all of the first pixel, then all of the second."""
    return x.unflatten(0, (-1, 4)).transpose(0, 1).flatten(0, 1)


def _by_channel(x: Tensor) -> Tensor:
    """The opposite of `_by_pixel`."""
    return x.unflatten(0, (4, -1)).transpose(0, 1).flatten(0, 1)


def _of_taps(part: Tensor, grad: Tensor) -> Tensor:
    """The gradient of the weight of one part, [O, C, 3, 3], of that of the result, `grad` [B, O, H,
    W]: G^T [sum of (A Y A^T) . (B^T d B) over all tiles] G."""
    (batch, channels, height, width), outputs = part.shape, grad.shape[1]
    given, grad = _last(part), _last(grad, outputs + -outputs % LANES)
    sizes = given.shape[3], grad.shape[3]
    sums = torch.zeros(SHARES, 36 * math.prod(sizes))
    of_rows = ends(None, height, width).numpy()
    _weigh(*flat(given, grad), *sizes, batch, height, width, of_rows, sums.numpy())
    taps = BOTH.T @ sums.sum(0).view(36, -1).double() / 24**2
    return taps.view(3, 3, *sizes).permute(3, 2, 0, 1)[:outputs, :channels].float()


def _stride(strips: int) -> int:
    """A step through `strips` that meets each once, and gives each thread its share of narrow and
    wide ones."""
    stride = max(1, int(GOLDEN * strips))
    while math.gcd(stride, strips) > 1:
        stride += 1
    return stride


def _last(part: Tensor, least: int = LANES) -> Tensor:
    """`part` [B, C, H, W] with the channels last and `least` of them, or more."""
    missing, part = least - part.shape[1], part.permute(0, 2, 3, 1)
    return functional.pad(part, (0, missing)) if missing > 0 else part


def _transformed(
    weight: Tensor, given: Sequence[int], channels: Sequence[int], outputs: int
) -> Tensor:
    """G g G^T of `weight`, [36, all `channels`, `outputs`]: of the `given` channels of each part,
    and of `outputs` filled up with 0."""
    found = weight.new_zeros(len(BOTH), sum(channels), outputs)
    at = 0
    for part, size in zip(weight.split(list(given), dim=1), channels, strict=False):
        taps = part.double().permute(2, 3, 1, 0).reshape(9, -1)
        found[:, at : at + part.shape[1], : len(weight)] = (BOTH @ taps / 24**2).view(
            36, -1, len(weight)
        )
        at += size
    return found


class _Lanes:
    """Operations on `LANES` numbers at once, in LLVM's terms: LLVM does not find out by itself that
    the arrays do not overlap."""

    kind = ir.VectorType(ir.FloatType(), LANES)

    def __init__(self, context, builder, signature, values) -> None:
        self.context, self.builder = context, builder
        self.signature, self.values = signature, values
        ends = ir.FunctionType(self.kind, [self.kind] * 3)
        name = f"llvm.fma.v{LANES}f32"
        self._fma = cgutils.get_or_insert_function(builder.module, ends, name)

    def place(self, array: int, at: ir.Value) -> ir.Value:
        """The numbers of an argument from the index `at` on."""
        kind, value = self.signature.args[array], self.values[array]
        data = make_array(kind)(self.context, self.builder, value).data
        return self.builder.bitcast(self.builder.gep(data, [at]), self.kind.as_pointer())

    def constant(self, number: float) -> ir.Constant:
        return ir.Constant(self.kind, [float(number)] * LANES)

    def fma(self, factor: float, x: ir.Value, y: ir.Value) -> ir.Value:
        return self.builder.call(self._fma, [self.constant(factor), x, y])

    def add(self, *terms: ir.Value) -> ir.Value:
        first, *others = terms
        for other in others:
            first = self.builder.fadd(first, other)
        return first

    def sub(self, x: ir.Value, y: ir.Value) -> ir.Value:
        return self.builder.fsub(x, y)


def _into(o: _Lanes, d: Sequence[ir.Value]) -> list[ir.Value]:
    """B^T d."""
    even, odd = o.fma(-4, d[2], d[4]), o.fma(-4, d[1], d[3])
    near, across = o.sub(d[4], d[2]), o.sub(d[3], d[1])
    return [
        o.fma(4, d[0], o.fma(-5, d[2], d[4])),
        o.add(even, odd),
        o.sub(even, odd),
        o.fma(2, across, near),
        o.fma(-2, across, near),
        o.fma(4, d[1], o.fma(-5, d[3], d[5])),
    ]


def _out_of(o: _Lanes, m: Sequence[ir.Value]) -> list[ir.Value]:
    """A^T m."""
    near, near_apart = o.add(m[1], m[2]), o.sub(m[1], m[2])
    far, far_apart = o.add(m[3], m[4]), o.sub(m[3], m[4])
    return [
        o.add(m[0], near, far),
        o.fma(2, far_apart, near_apart),
        o.fma(4, far, near),
        o.add(o.fma(8, far_apart, near_apart), m[5]),
    ]


def _back(o: _Lanes, y: Sequence[ir.Value]) -> list[ir.Value]:
    """A y."""
    even, odd = o.add(y[0], y[2]), o.add(y[1], y[3])
    far, far_odd = o.fma(4, y[2], y[0]), o.fma(4, y[3], y[1])
    return [
        y[0],
        o.add(even, odd),
        o.sub(even, odd),
        o.fma(2, far_odd, far),
        o.fma(-2, far_odd, far),
        y[3],
    ]


def _along(how: Callable[[_Lanes, Sequence[ir.Value]], list[ir.Value]], inputs: int = 6):
    """An intrinsic: reads `inputs` vectors from `at` on, `step` apart, writes `how` of them."""

    @intrinsic
    def transform(typing, source, at, step, target, to, apart):
        def generate(context, builder, signature, values):
            o = _Lanes(context, builder, signature, values)

            def place(array: int, number: int) -> ir.Value:
                ahead = builder.mul(values[array + 2], ir.Constant(ir.IntType(64), number))
                return o.place(array, builder.add(values[array + 1], ahead))

            given = [builder.load(place(0, number), align=4) for number in range(inputs)]
            for number, result in enumerate(how(o, given)):
                builder.store(result, place(3, number), align=4)
            return context.get_dummy_value()

        n = types.int64
        return types.void(source, n, n, target, n, n), generate

    return transform


_to_tile, _from_tile, _to_sums = _along(_into), _along(_out_of), _along(_back, 4)


@intrinsic
def _finish(typing, source, at, bias, b_at, plus, p_at, adds, relu, target, to):
    """target = source + bias, + plus if `adds`, no number negative if `relu`; NaN stays."""

    def generate(context, builder, signature, values):
        o = _Lanes(context, builder, signature, values)

        def load(array: int) -> ir.Value:
            return builder.load(o.place(array, values[array + 1]), align=4)

        plain, before = o.add(load(0), load(2)), builder.block
        with builder.if_then(values[6]):
            more, inside = o.add(load(4), plain), builder.block
        total = builder.phi(o.kind)
        total.add_incoming(plain, before)
        total.add_incoming(more, inside)
        zero = o.constant(0)
        negative = builder.fcmp_ordered("<", total, zero)
        shown = builder.select(values[7], builder.select(negative, zero, total), total)
        builder.store(shown, o.place(8, values[9]), align=4)
        return context.get_dummy_value()

    n, yes = types.int64, types.boolean
    return types.void(source, n, bias, n, plus, n, yes, yes, target, n), generate


@jit(parallel=True, error_model="numpy")
def _convolve(
    one, other, c_one, c_other, batch, height, width, stride, ends, weight, bias, padded, outputs,
    relu, adds, shuffled, plus, out,
):  # fmt: skip
    """Arrays are flat, with channels last; `ends` are of rows. Each strip of four rows is computed
    by itself, `stride` strips after the one before."""
    down, channels, pixels = (height + 3) // 4, c_one + c_other, height * width
    for number in prange(batch * down):
        strip = number * stride % (batch * down)
        picture, top = strip // down, 4 * (strip % down)
        begin, end = ends[top, 0] // 4, (ends[top, 1] + 3) // 4
        if begin >= end:
            continue
        blocks = (end - begin + TILES - 1) // TILES
        size = (end - begin + blocks - 1) // blocks
        tiles, results = np.empty(36 * size * channels, f32), np.empty(36 * size * padded, f32)
        patch, space = np.zeros(36 * max(c_one, c_other), f32), np.empty(36 * LANES, f32)
        square, none = np.empty(16 * LANES, f32), np.zeros(padded, f32)
        for first in range(begin, end, size):
            count = min(size, end - first)
            for t in range(count):
                left, to = 4 * (first + t), t * channels
                _tile(one, picture * pixels * c_one, c_one, height, width, top, left, ends,
                      patch, space, tiles, to, count * channels)  # fmt: skip
                _tile(other, picture * pixels * c_other, c_other, height, width, top, left, ends,
                      patch, space, tiles, to + c_one, count * channels)  # fmt: skip
            for n in range(36):
                here = n * count
                w = weight[n * channels * padded : (n + 1) * channels * padded]
                multiply(count, tiles, here * channels, channels, 1, w, padded, none,
                         results, here * padded, channels, False)  # fmt: skip
            for t in range(count):
                left = 4 * (first + t)
                for k in range(0, padded, LANES):
                    _pixels(results, t * padded + k, count * padded, space, square)
                    for i in range(min(4, height - top)):
                        for j in range(min(4, width - left)):
                            y, x, at = top + i, left + j, (4 * i + j) * LANES
                            if shuffled:
                                part, c = k // (outputs // 4), k % (outputs // 4)
                                y, x = 2 * y + part // 2, 2 * x + part % 2
                                row = (picture * 2 * height + y) * 2 * width + x
                                to = row * (outputs // 4) + c
                            else:
                                to = ((picture * height + y) * width + x) * outputs + k
                            if k + LANES <= outputs:
                                _finish(square, at, bias, k, plus, to, adds, relu, out, to)
                            else:
                                for c in range(outputs - k):
                                    value = square[at + c] + bias[k + c]
                                    value = value + plus[to + c] if adds else value
                                    out[to + c] = f32(0) if relu and value < f32(0) else value


@jit(error_model="numpy")
def _tile(
    source, start, channels, height, width, top, left, ends, patch, space, tiles, to, step
):  # fmt: skip
    """B^T d B of the 6 x 6 pixels around the 4 x 4 from `top`, `left` on, into 36 places of `tiles`
    that are `step` apart. Pixels beyond the `ends` of their row count as 0."""
    if channels == 0:
        return
    top, left = top - 1, left - 1
    at, row = start + (top * width + left) * channels, width * channels
    inside = top >= 0 and top + 6 <= height
    for y in range(max(top, 0), min(top + 6, height)):
        inside = inside and ends[y, 0] <= left and left + 6 <= ends[y, 1]
    if not inside:
        for i in range(6):
            y = min(max(top + i, 0), height - 1)
            for j in range(6):
                there = y == top + i and ends[y, 0] <= left + j < ends[y, 1]
                for c in range(channels):
                    seen = source[at + i * row + j * channels + c] if there else f32(0)
                    patch[(6 * i + j) * channels + c] = seen
        source, at, row = patch, 0, 6 * channels
    c = 0
    while c < channels:
        c = min(c, channels - LANES)  # the last ones overlap: some are computed twice
        for j in range(6):
            _to_tile(source, at + j * channels + c, row, space, j * LANES, 6 * LANES)
        for i in range(6):
            _to_tile(space, 6 * i * LANES, LANES, tiles, to + c + 6 * i * step, step)
        c += LANES


@jit(error_model="numpy")
def _pixels(results, at, step, space, square):
    """A^T m A of 36 vectors that are `step` apart: `square` [4, 4, LANES]."""
    for j in range(6):
        _from_tile(results, at + j * step, 6 * step, space, j * LANES, 6 * LANES)
    for i in range(4):
        _from_tile(space, 6 * i * LANES, LANES, square, 4 * i * LANES, LANES)


@jit(parallel=True, error_model="numpy")
def _weigh(given, grad, channels, outputs, batch, height, width, ends, sums):
    """Sums over tiles of (A Y A^T) . (B^T d B): `sums` [SHARES, 36 * channels * outputs]. Arrays
    are flat, with channels last."""
    down, across, pixels = (height + 3) // 4, (width + 3) // 4, height * width
    size, square = min(across, TILES), channels * outputs
    for share in prange(len(sums)):
        total = sums[share]
        tiles, wanted = np.empty(36 * size * channels, f32), np.empty(36 * size * outputs, f32)
        patch, space = np.zeros(36 * max(channels, outputs), f32), np.empty(36 * LANES, f32)
        product, none = np.empty(square, f32), np.zeros(outputs, f32)
        for strip in range(share, batch * down, len(sums)):
            picture, top = strip // down, 4 * (strip % down)
            for first in range(0, across, size):
                count = min(size, across - first)
                for t in range(count):
                    left = 4 * (first + t)
                    _tile(given, picture * pixels * channels, channels, height, width, top, left,
                          ends, patch, space, tiles, t * channels, count * channels)  # fmt: skip
                    _square(grad, picture * pixels * outputs, outputs, height, width, top, left,
                            patch, space, wanted, t * outputs, count * outputs)  # fmt: skip
                for n in range(36):
                    w = wanted[n * count * outputs : (n + 1) * count * outputs]
                    multiply(channels, tiles, n * count * channels, 1, channels, w, outputs, none,
                             product, 0, count, False)  # fmt: skip
                    for k in range(square):
                        total[n * square + k] += product[k]


@jit(error_model="numpy")
def _square(
    source, start, channels, height, width, top, left, patch, space, tiles, to, step
):  # fmt: skip
    """A Y A^T of the 4 x 4 pixels from `top`, `left` on, into 36 places of `tiles` that are `step`
    apart."""
    at, row = start + (top * width + left) * channels, width * channels
    if top + 4 > height or left + 4 > width:
        for i in range(4):
            for j in range(4):
                there = top + i < height and left + j < width
                for c in range(channels):
                    seen = source[at + i * row + j * channels + c] if there else f32(0)
                    patch[(4 * i + j) * channels + c] = seen
        source, at, row = patch, 0, 4 * channels
    for c in range(0, channels, LANES):
        for j in range(4):
            _to_sums(source, at + j * channels + c, row, space, j * LANES, 4 * LANES)
        for i in range(6):
            _to_sums(space, 4 * i * LANES, LANES, tiles, to + c + 6 * i * step, step)


@jit(parallel=True, error_model="numpy")
def _halve(given, out, ends):
    """`given` [rows, W, C] with the rows of all pictures, an even number in each; `ends` are of the
    rows of one."""
    for y in prange(len(out)):
        first, end = ends[2 * y % len(ends)]
        for x in range(first // 2, end // 2):
            for c in range(out.shape[2]):
                above = _larger(given[2 * y, 2 * x, c], given[2 * y, 2 * x + 1, c])
                below = _larger(given[2 * y + 1, 2 * x, c], given[2 * y + 1, 2 * x + 1, c])
                out[y, x, c] = _larger(above, below)


@jit()
def _larger(x, y):
    """The larger number; NaN if one is."""
    return y if y > x or y != y else x
