"""Rows and pixels of cells with Triton: a lane takes a number that is written.

Every number is written once, in the order of memory; what it is made of is read by the lanes beside
it, too, and comes from the cache. Of memory, rows are 4 bytes a column to write, and what is seen
to read; pixels are 12 bytes to write, and rows, output, matrix and base to read.

The backward passes compute again what the reference does and differentiate that. Whether an index
names no point is asked once, after all is launched: here the host waits for that alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import space_to_depth as interface
from methods.kernels.gpu import check_types, launch
from methods.kernels.space_to_depth import CellInputs, Layout, Pair, reference

BLOCK = 512
"""Numbers of a program, 4 a lane: a number is made of several loads, which hide how long one
takes."""

TAPS = tl.constexpr(interface.TAPS)


def space_to_depth(inputs: CellInputs, layout: Layout, taps: Tensor, count: int) -> Pair:
    """See `methods.kernels.space_to_depth.space_to_depth`."""
    learned = _learned(inputs)
    check_types(torch.float32, values=inputs.values, alpha=inputs.alpha, points=learned[-1])
    return _SpaceToDepth.apply(inputs, layout, taps, count, *learned)


def depth_to_space(
    base: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None, layout: Layout
) -> Tensor:
    """See `methods.kernels.space_to_depth.depth_to_space`."""
    check_types(torch.float32, base=base, rows=rows)
    matrices = () if matrix is None else (matrix.float(),)
    return _DepthToSpace.apply(layout, base, rows, output.float(), *matrices)


def _learned(inputs: CellInputs) -> list[Tensor]:
    """What the rows are differentiable in."""
    pairs = [*inputs.preceding, *([inputs.surface] if inputs.surface else [])]
    return [inputs.values, inputs.alpha, *(points for points, _ in pairs)]


def _with(inputs: CellInputs, values: Tensor, alpha: Tensor, *points: Tensor) -> CellInputs:
    """`inputs` with others in place of `_learned(inputs)`."""
    pairs = list(zip(points, (index for _, index in inputs.preceding), strict=False))
    surface = (points[-1], inputs.surface[1]) if inputs.surface else None
    return replace(inputs, values=values, alpha=alpha, preceding=pairs, surface=surface)


class _SpaceToDepth(torch.autograd.Function):
    @staticmethod
    def forward(ctx, inputs, layout, taps, count, *learned):
        ctx.given = inputs, layout, taps, count
        ctx.save_for_backward(*learned)
        return _rows(_with(inputs, *(x.detach() for x in learned)), layout, taps, count)

    @staticmethod
    def backward(ctx, *grads):
        inputs, *others = ctx.given

        def again(*learned: Tensor) -> Pair:
            return reference.space_to_depth(_with(inputs, *learned), *others)

        return None, None, None, None, *_gradients(again, ctx.saved_tensors, grads)


class _DepthToSpace(torch.autograd.Function):
    @staticmethod
    def forward(ctx, layout, *parts):
        ctx.layout = layout
        ctx.save_for_backward(*parts)
        return _drawn(layout, *(x.detach().contiguous() for x in parts))

    @staticmethod
    def backward(ctx, grad):
        def again(base: Tensor, rows: Tensor, output: Tensor, *matrix: Tensor) -> tuple[Tensor]:
            shared = next(iter(matrix), None)
            return (reference.depth_to_space(base, rows, output, shared, ctx.layout),)

        return None, *_gradients(again, ctx.saved_tensors, (grad,))


def _gradients(
    again: Callable[..., tuple[Tensor, ...]],
    inputs: tuple[Tensor, ...],
    grads: tuple[Tensor, ...],
) -> tuple[Tensor, ...]:
    """Of what `again` computes from `inputs`."""
    with torch.enable_grad():
        fresh = [x.detach().requires_grad_() for x in inputs]
        return torch.autograd.grad(again(*fresh), fresh, grads, materialize_grads=True)


def _rows(inputs: CellInputs, layout: Layout, taps: Tensor, count: int) -> Pair:
    values, alpha, background, cells = (
        x.contiguous() for x in (inputs.values, inputs.alpha, inputs.background, inputs.cells)
    )
    height, width, channels = values.shape
    number, pixels, begins = len(cells), layout.scale**2, layout.begins
    each = pixels * (channels + 1)  # columns of a picture
    base, rows = values.new_empty(number, pixels, 3), values.new_empty(count, layout.width)
    wrong = torch.zeros(1, dtype=torch.int32, device=values.device)
    into = rows, layout.width
    rows[number:] = 0
    samples = values, background, cells, height, width, taps.contiguous()
    _launch(_base, base.numel(), layout, *samples, base)
    _launch(_present, number * (channels + 1), layout, values, alpha, background, cells, *into)
    for age in range(layout.frames):
        begin = begins[f"preceding {age}"]
        if age < len(inputs.preceding):
            points, index = (x.contiguous() for x in inputs.preceding[age])
            where = background, cells, width, *into, begin, wrong
            _launch(_preceding, number * each, layout, points, len(points), index, *where)
        else:
            rows[:, begin : begin + each] = 0
    if layout.history:
        begin = begins["history"]
        if inputs.history is not None:
            recent = (x.contiguous() for x in inputs.history)
            _launch(_history, number * pixels * 4, layout, *recent, background, base, *into, begin)
        else:
            rows[:, begin : begin + 4 * pixels] = 0
    if layout.surface:
        begin = begins["surface"]
        if inputs.surface is not None:
            points, index = (x.contiguous() for x in inputs.surface)
            there = background, base, *into, begin, wrong
            _launch(_surface, number * each, layout, points, len(points), index, *there)
        else:
            rows[:, begin:] = 0
    if found := int(wrong):
        raise ValueError(f"index: expected -1 or that of a point, got {found} that are neither")
    return base, rows


def _drawn(
    layout: Layout, base: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None = None
) -> Tensor:
    pixels, begins = torch.empty_like(base), layout.begins
    given = base, rows, layout.width, output, matrix, pixels
    at = {name.upper(): begins.get(name, -1) for name in ("history", "surface")}
    _launch(_pixels, pixels.numel(), layout, *given, **at)
    return pixels


def _launch(
    kernel: triton.JITFunction,
    total: int,
    layout: Layout,
    *given: Tensor | int | None,
    **options: int,
) -> None:
    """Run `kernel`, which writes `total` numbers."""
    options |= {"SCALE": layout.scale, "FEATURES": layout.channels + 1, "BLOCK": BLOCK}
    launch(kernel, (triton.cdiv(total, BLOCK),), *given, total, **options)


@triton.jit
def _block(total, BLOCK: tl.constexpr):
    """The numbers that a program writes, and which of them there are."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return i, i < total


@triton.jit
def _base(
    values,
    background,
    cells,
    height,
    width,
    taps,
    base,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    c, sub = i % 3, i // 3 % (SCALE * SCALE)
    cell = tl.load(cells + i // (3 * SCALE * SCALE), mask=inside, other=0).to(tl.int32)
    row, column = cell // width, cell % width
    less = tl.load(background + c)
    blended = tl.zeros([BLOCK], tl.float32)
    for tap in tl.static_range(TAPS):
        y = tl.minimum(tl.maximum(row + (tap // 3 - 1), 0), height - 1)
        x = tl.minimum(tl.maximum(column + (tap % 3 - 1), 0), width - 1)
        near = values + (y * width + x).to(tl.int64) * (FEATURES - 1)
        colour = tl.load(near + c, mask=inside, other=0.0) - less
        blended += tl.load(taps + sub * TAPS + tap) * colour
    tl.store(base + i, blended, mask=inside)


@triton.jit
def _source(f, FEATURES: tl.constexpr):
    """The feature of a column: colours, opacity, which is last in memory, the rest."""
    return tl.where(f < 3, f, tl.where(f == 3, FEATURES - 1, f - 1))


@triton.jit
def _less_background(features, background, source, seen, FEATURES: tl.constexpr):
    """Numbers of `features`, pointers to rows, less their background; 0 for an opacity."""
    feature = seen & (source < FEATURES - 1)
    shown = tl.load(features + source, mask=feature, other=0.0)
    return shown - tl.load(background + source, mask=feature, other=0.0)


@triton.jit
def _seen(point, points, f, wrong):
    """Where there is a point; counts the pixels that name none of the `points`."""
    unknown = (f == 0) & ((point < -1) | (point >= points))
    found = tl.sum(unknown.to(tl.int32), 0)
    if found > 0:
        tl.atomic_add(wrong, found, sem="relaxed")
    return (point >= 0) & (point < points)


@triton.jit
def _present(
    values,
    alpha,
    background,
    cells,
    rows,
    columns,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, source = i // FEATURES, _source(i % FEATURES, FEATURES)
    cell = tl.load(cells + n, mask=inside, other=0)
    features = values + cell * (FEATURES - 1)
    less = _less_background(features, background, source, inside, FEATURES)
    opacity = tl.load(alpha + cell, mask=inside & (source == FEATURES - 1), other=0.0)
    tl.store(rows + n * columns + i % FEATURES, less + opacity, mask=inside)


@triton.jit
def _preceding(
    values,
    points,
    index,
    background,
    cells,
    width,
    rows,
    columns,
    begin,
    wrong,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, place = i // (SCALE * SCALE * FEATURES), i % (SCALE * SCALE * FEATURES)
    sub, f = place // FEATURES, place % FEATURES
    cell = tl.load(cells + n, mask=inside, other=0).to(tl.int32)
    row, column = cell // width * SCALE + sub // SCALE, cell % width * SCALE + sub % SCALE
    shown = index + row * (width * SCALE) + column
    point = tl.load(shown, mask=inside, other=-1).to(tl.int64)
    seen, source = _seen(point, points, f, wrong), _source(f, FEATURES)
    features = values + point * (FEATURES - 1)
    less = _less_background(features, background, source, seen, FEATURES)
    opacity = (seen & (source == FEATURES - 1)).to(tl.float32)
    tl.store(rows + n * columns + begin + place, less + opacity, mask=inside)


@triton.jit
def _history(
    picture,
    valid,
    background,
    base,
    rows,
    columns,
    begin,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, place = i // (SCALE * SCALE * 4), i % (SCALE * SCALE * 4)
    pixel, c = i // 4, i % 4
    known = tl.load(valid + pixel, mask=inside, other=0.0)
    colour = inside & (c < 3)
    less = tl.load(picture + 3 * pixel + c, mask=colour, other=0.0)
    less -= tl.load(background + c, mask=colour, other=0.0)
    less -= tl.load(base + 3 * pixel + c, mask=colour, other=0.0)
    shown = tl.where(c < 3, less * known, known)
    tl.store(rows + n * columns + begin + place, shown, mask=inside)


@triton.jit
def _surface(
    values,
    points,
    index,
    background,
    base,
    rows,
    columns,
    begin,
    wrong,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, place = i // (SCALE * SCALE * FEATURES), i % (SCALE * SCALE * FEATURES)
    pixel, f = i // FEATURES, i % FEATURES
    point = tl.load(index + pixel, mask=inside, other=-1).to(tl.int64)
    seen, source = _seen(point, points, f, wrong), _source(f, FEATURES)
    features = values + point * FEATURES
    less = _less_background(features, background, source, seen, FEATURES)
    less -= tl.load(base + 3 * pixel + f, mask=seen & (f < 3), other=0.0)
    opacity = tl.load(features + source, mask=seen & (source == FEATURES - 1), other=0.0)
    tl.store(rows + n * columns + begin + place, less + opacity, mask=inside)


@triton.jit
def _pixels(
    base,
    rows,
    columns,
    output,
    matrix,
    pixels,
    total,
    HISTORY: tl.constexpr,
    SURFACE: tl.constexpr,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """`HISTORY` and `SURFACE` are where their columns begin, -1 for nowhere."""
    i, inside = _block(total, BLOCK)
    pixel, c = i // 3, i % 3
    n, sub = pixel // (SCALE * SCALE), pixel % (SCALE * SCALE)
    answer = output + pixel * (3 + (HISTORY >= 0))
    shown = tl.load(base + i, mask=inside, other=0.0)
    shown += tl.load(answer + c, mask=inside, other=0.0)
    if HISTORY >= 0:
        recent = rows + n * columns + HISTORY + 4 * sub
        share = tl.sigmoid(tl.load(answer + 3, mask=inside, other=0.0))
        share *= tl.load(recent + 3, mask=inside, other=0.0)
        shown += share * tl.load(recent + c, mask=inside, other=0.0)
    if SURFACE >= 0:
        surface = rows + n * columns + SURFACE + FEATURES * sub
        opacity = tl.load(surface + 3, mask=inside, other=0.0)
        read = tl.zeros([BLOCK], tl.float32)
        for f in tl.static_range(FEATURES):
            value = tl.load(surface + f, mask=inside, other=0.0)
            weighted = value * opacity if f < 3 else value
            entry = matrix + (3 * n + c) * FEATURES + f
            read += weighted * tl.load(entry, mask=inside, other=0.0)
        shown += read
    tl.store(pixels + i, shown, mask=inside)
