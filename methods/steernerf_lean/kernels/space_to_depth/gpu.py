"""Rows and pixels of cells with Triton: one lane per number that is written.

Every number is written once, in memory order; its inputs are also read by neighbouring lanes and
come from the cache. Memory traffic: rows write 4 bytes per column and read the visible inputs;
pixels write 12 bytes and read rows, output, matrix and base.

Samples and points that several cells share get their gradients by atomics, whose order is not
repeatable. If torch is set to use deterministic algorithms, the reference is differentiated
instead. All other gradients are written once. Out-of-range indices are checked once, after all
launches; this is the only wait of the host.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import space_to_depth as interface
from methods.kernels.gpu import check_types, launch
from methods.steernerf_lean.kernels.space_to_depth import CellInputs, Layout, Pair, reference

BLOCK = 512
"""Numbers per program, 4 per lane; each takes several loads, which hide their latency."""

TAPS = tl.constexpr(interface.TAPS)


def space_to_depth(inputs: CellInputs, layout: Layout, taps: Tensor, count: int) -> Pair:
    """See `methods.steernerf_lean.kernels.space_to_depth.space_to_depth`."""
    learned = _learned(inputs)
    check_types(torch.float32, values=inputs.values, alpha=inputs.alpha, points=learned[-1])
    return _SpaceToDepth.apply(inputs, layout, taps, count, *learned)


def depth_to_space(
    base: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None, layout: Layout
) -> Tensor:
    """See `methods.steernerf_lean.kernels.space_to_depth.depth_to_space`."""
    check_types(torch.float32, base=base, rows=rows)
    matrices = () if matrix is None else (matrix.float(),)
    return _DepthToSpace.apply(layout, base, rows, output.float(), *matrices)


def _learned(inputs: CellInputs) -> list[Tensor]:
    """The inputs in which the rows are differentiable."""
    pairs = [*inputs.preceding, *([inputs.surface] if inputs.surface else [])]
    return [inputs.values, inputs.alpha, *(points for points, _ in pairs)]


def _with(inputs: CellInputs, values: Tensor, alpha: Tensor, *points: Tensor) -> CellInputs:
    """`inputs` with the given tensors in place of `_learned(inputs)`."""
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
        inputs, layout, taps, count = ctx.given
        learned, wanted = ctx.saved_tensors, ctx.needs_input_grad[4:]
        if torch.are_deterministic_algorithms_enabled():
            with torch.enable_grad():
                fresh = [x.detach().requires_grad_() for x in learned]
                found = reference.space_to_depth(_with(inputs, *fresh), layout, taps, count)
            added: Sequence[Tensor | None] = torch.autograd.grad(found, fresh, grads)
        else:
            pairs = zip(learned, wanted, strict=True)
            added = [x.new_zeros(x.shape) if want else None for x, want in pairs]
            grad_base, grad_rows = (grad.contiguous() for grad in grads)
            _add(inputs, layout, taps, grad_base, grad_rows, added)
        return None, None, None, None, *added


class _DepthToSpace(torch.autograd.Function):
    @staticmethod
    def forward(ctx, layout, *parts):
        base, *rest = (x.detach().contiguous() for x in parts)
        ctx.layout = layout
        ctx.save_for_backward(*rest)
        return _drawn(layout, base, *rest)

    @staticmethod
    def backward(ctx, grad):
        return None, grad, *_undrawn(ctx.layout, grad.contiguous(), *ctx.saved_tensors)


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


def _add(
    inputs: CellInputs,
    layout: Layout,
    taps: Tensor,
    grad_base: Tensor,
    grad_rows: Tensor,
    grads: Sequence[Tensor | None],
) -> None:
    """Add to the `grads` of `_learned(inputs)`, skipping those that are None."""
    height, width, channels = inputs.values.shape
    cells, pixels, begins = inputs.cells.contiguous(), layout.scale**2, layout.begins
    number, each = len(cells), pixels * (channels + 1)
    values, alpha, *points = grads
    rows = grad_rows, layout.width
    known = inputs.history[1].contiguous() if inputs.history else None
    at_surface = inputs.surface[1].contiguous() if inputs.surface else None
    where = _places(layout).values()
    whole = torch.empty_like(grad_base)
    _launch(_base_back, whole.numel(), layout, grad_base, known, at_surface, *rows, *where, whole)
    if values is not None:
        samples = cells, height, width, taps.contiguous()
        _launch(_taps_back, 3 * number * interface.TAPS, layout, whole, *samples, values)
    if values is not None or alpha is not None:
        _launch(_present_back, number * (channels + 1), layout, cells, *rows, values, alpha)
    for age, (_, index) in enumerate(inputs.preceding):
        if points[age] is not None:
            given = index.contiguous(), cells, width, *rows, begins[f"preceding {age}"]
            _launch(_preceding_back, number * each, layout, *given, points[age])
    if inputs.surface and points[-1] is not None:
        begin = begins["surface"]
        _launch(_surface_back, number * each, layout, at_surface, *rows, begin, points[-1])


def _drawn(
    layout: Layout, base: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None = None
) -> Tensor:
    pixels = torch.empty_like(base)
    given = base, rows, layout.width, output, matrix, pixels
    at = {name.upper(): begin for name, begin in _places(layout).items()}
    _launch(_pixels, pixels.numel(), layout, *given, **at)
    return pixels


def _undrawn(
    layout: Layout, grad: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None = None
) -> list[Tensor]:
    """Gradients of all inputs of `_drawn` except the base, whose gradient is `grad` itself."""
    grads = [torch.zeros_like(x) for x in (rows, output, matrix) if x is not None]
    at = {name.upper(): begin for name, begin in _places(layout).items()}
    number, pixels = grad.shape[:2]
    given = grad, rows, layout.width
    outputs = number * output.shape[1]
    _launch(_output_back, outputs, layout, *given, output, *grads[:2], **at)
    if matrix is not None:
        at.pop("HISTORY")
        features = number * matrix.shape[1]
        _launch(_read_back, features // 3 * pixels, layout, *given, matrix, grads[0], **at)
        _launch(_matrix_back, features, layout, *given, grads[2], **at)
    return grads


def _places(layout: Layout) -> dict[str, int]:
    """First columns of history and surface, -1 if absent."""
    return {name: layout.begins.get(name, -1) for name in ("history", "surface")}


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
    """The numbers that a program writes, and the mask of those that exist."""
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    return i, i < total


@triton.jit
def _near(cell, tap, height, width):
    """Index of the sample at tap 0 to 8 of the 3 x 3 around a cell, border repeated."""
    y = tl.minimum(tl.maximum(cell // width + (tap // 3 - 1), 0), height - 1)
    x = tl.minimum(tl.maximum(cell % width + (tap % 3 - 1), 0), width - 1)
    return (y * width + x).to(tl.int64)


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
    less = tl.load(background + c)
    blended = tl.zeros([BLOCK], tl.float32)
    for tap in tl.static_range(TAPS):
        near = values + _near(cell, tap, height, width) * (FEATURES - 1)
        colour = tl.load(near + c, mask=inside, other=0.0) - less
        blended += tl.load(taps + sub * TAPS + tap) * colour
    tl.store(base + i, blended, mask=inside)


@triton.jit
def _source(f, FEATURES: tl.constexpr):
    """Memory index of a column's feature; columns are colours, opacity (last in memory), rest."""
    return tl.where(f < 3, f, tl.where(f == 3, FEATURES - 1, f - 1))


@triton.jit
def _less_background(features, background, source, seen, FEATURES: tl.constexpr):
    """Load features minus background; `features` are pointers to rows, opacity has background 0."""
    feature = seen & (source < FEATURES - 1)
    shown = tl.load(features + source, mask=feature, other=0.0)
    return shown - tl.load(background + source, mask=feature, other=0.0)


@triton.jit
def _seen(point, points, f, wrong):
    """Whether a pixel shows a point; counts indices that are out of range of `points`."""
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
def _in_cell(index, cells, width, n, sub, inside, SCALE: tl.constexpr):
    """The points shown by the pixels `sub` of cells."""
    cell = tl.load(cells + n, mask=inside, other=0).to(tl.int32)
    row, column = cell // width * SCALE + sub // SCALE, cell % width * SCALE + sub % SCALE
    shown = index + row * (width * SCALE) + column
    return tl.load(shown, mask=inside, other=-1).to(tl.int64)


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
    point = _in_cell(index, cells, width, n, sub, inside, SCALE)
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
    """`HISTORY` and `SURFACE` are first columns, -1 if absent."""
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


@triton.jit
def _base_back(
    grad_base,
    known,
    at_surface,
    rows,
    columns,
    history,
    surface,
    whole,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """`whole`: also includes gradients through the columns that are relative to the base."""
    i, inside = _block(total, BLOCK)
    pixel, c = i // 3, i % 3
    n, sub = pixel // (SCALE * SCALE), pixel % (SCALE * SCALE)
    row = rows + n * columns
    grad = tl.load(grad_base + i, mask=inside, other=0.0)
    if known is not None:
        share = tl.load(known + pixel, mask=inside, other=0.0)
        grad -= share * tl.load(row + history + 4 * sub + c, mask=inside, other=0.0)
    if at_surface is not None:
        seen = tl.load(at_surface + pixel, mask=inside, other=-1) >= 0
        grad -= tl.load(row + surface + FEATURES * sub + c, mask=seen, other=0.0)
    tl.store(whole + i, grad, mask=inside)


@triton.jit
def _taps_back(
    whole,
    cells,
    height,
    width,
    taps,
    grad_values,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Adjoint of `_base`."""
    i, inside = _block(total, BLOCK)
    n, tap, c = i // (3 * TAPS), (i // 3 % TAPS).to(tl.int32), i % 3
    cell = tl.load(cells + n, mask=inside, other=0).to(tl.int32)
    grad = tl.zeros([BLOCK], tl.float32)
    for sub in range(SCALE * SCALE):
        share = tl.load(whole + (n * (SCALE * SCALE) + sub) * 3 + c, mask=inside, other=0.0)
        grad += tl.load(taps + sub * TAPS + tap) * share
    near = grad_values + _near(cell, tap, height, width) * (FEATURES - 1)
    tl.atomic_add(near + c, grad, mask=inside, sem="relaxed")


@triton.jit
def _present_back(
    cells,
    rows,
    columns,
    grad_values,
    grad_alpha,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, source = i // FEATURES, _source(i % FEATURES, FEATURES)
    cell = tl.load(cells + n, mask=inside, other=0)
    grad = tl.load(rows + n * columns + i % FEATURES, mask=inside, other=0.0)
    last = source == FEATURES - 1
    if grad_values is not None:
        feature = grad_values + cell * (FEATURES - 1) + source
        tl.atomic_add(feature, grad, mask=inside & (last == 0), sem="relaxed")
    if grad_alpha is not None:
        tl.atomic_add(grad_alpha + cell, grad, mask=inside & last, sem="relaxed")


@triton.jit
def _preceding_back(
    index,
    cells,
    width,
    rows,
    columns,
    begin,
    grad_values,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, place = i // (SCALE * SCALE * FEATURES), i % (SCALE * SCALE * FEATURES)
    point = _in_cell(index, cells, width, n, place // FEATURES, inside, SCALE)
    source = _source(place % FEATURES, FEATURES)
    learned = (point >= 0) & (source < FEATURES - 1)
    grad = tl.load(rows + n * columns + begin + place, mask=learned, other=0.0)
    feature = grad_values + point * (FEATURES - 1) + source
    tl.atomic_add(feature, grad, mask=learned, sem="relaxed")


@triton.jit
def _surface_back(
    index,
    rows,
    columns,
    begin,
    grad_values,
    total,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, place = i // (SCALE * SCALE * FEATURES), i % (SCALE * SCALE * FEATURES)
    point = tl.load(index + i // FEATURES, mask=inside, other=-1).to(tl.int64)
    seen, source = point >= 0, _source(place % FEATURES, FEATURES)
    grad = tl.load(rows + n * columns + begin + place, mask=seen, other=0.0)
    tl.atomic_add(grad_values + point * FEATURES + source, grad, mask=seen, sem="relaxed")


@triton.jit
def _output_back(
    grad,
    rows,
    columns,
    output,
    grad_rows,
    grad_output,
    total,
    HISTORY: tl.constexpr,
    SURFACE: tl.constexpr,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gradients of the output and of the history's columns, which are equally many."""
    i, inside = _block(total, BLOCK)
    OUTPUTS: tl.constexpr = 3 + (HISTORY >= 0)
    pixel, o = i // OUTPUTS, i % OUTPUTS
    colour = o < 3
    gain = tl.load(grad + 3 * pixel + o, mask=inside & colour, other=0.0)
    if HISTORY < 0:
        tl.store(grad_output + i, gain, mask=inside)
    else:
        n, sub = pixel // (SCALE * SCALE), pixel % (SCALE * SCALE)
        place = n * columns + HISTORY + 4 * sub
        known = tl.load(rows + place + 3, mask=inside, other=0.0)
        share = tl.sigmoid(tl.load(output + 4 * pixel + 3, mask=inside, other=0.0))
        along = tl.zeros([BLOCK], tl.float32)
        for c in tl.static_range(3):
            of_colour = tl.load(grad + 3 * pixel + c, mask=inside, other=0.0)
            along += of_colour * tl.load(rows + place + c, mask=inside, other=0.0)
        of_logit = share * (1 - share) * known * along
        tl.store(grad_output + i, tl.where(colour, gain, of_logit), mask=inside)
        recent = tl.where(colour, share * known * gain, share * along)
        tl.store(grad_rows + place + o, recent, mask=inside)


@triton.jit
def _read_back(
    grad,
    rows,
    columns,
    matrix,
    grad_rows,
    total,
    SURFACE: tl.constexpr,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Gradients of the surface's columns; that of the opacity includes its weight on colours."""
    i, inside = _block(total, BLOCK)
    pixel, f = i // FEATURES, i % FEATURES
    n, sub = pixel // (SCALE * SCALE), pixel % (SCALE * SCALE)
    surface = n * columns + SURFACE + FEATURES * sub
    slope, of_colours = tl.zeros([BLOCK], tl.float32), tl.zeros([BLOCK], tl.float32)
    weighs = inside & (f == 3)
    for c in tl.static_range(3):
        gain = tl.load(grad + 3 * pixel + c, mask=inside, other=0.0)
        entry = matrix + (3 * n + c) * FEATURES
        slope += gain * tl.load(entry + f, mask=inside, other=0.0)
        for k in tl.static_range(3):
            value = tl.load(rows + surface + k, mask=weighs, other=0.0)
            of_colours += gain * tl.load(entry + k, mask=weighs, other=0.0) * value
    opacity = tl.load(rows + surface + 3, mask=inside, other=0.0)
    weight = tl.where(f < 3, opacity, 1.0)
    tl.store(grad_rows + surface + f, weight * slope + of_colours, mask=inside)


@triton.jit
def _matrix_back(
    grad,
    rows,
    columns,
    grad_matrix,
    total,
    SURFACE: tl.constexpr,
    SCALE: tl.constexpr,
    FEATURES: tl.constexpr,
    BLOCK: tl.constexpr,
):
    i, inside = _block(total, BLOCK)
    n, c, f = i // (3 * FEATURES), i // FEATURES % 3, i % FEATURES
    slope = tl.zeros([BLOCK], tl.float32)
    for sub in range(SCALE * SCALE):
        surface = rows + n * columns + SURFACE + FEATURES * sub
        value = tl.load(surface + f, mask=inside, other=0.0)
        value *= tl.load(surface + 3, mask=inside & (f < 3), other=1.0)
        slope += value * tl.load(grad + 3 * (n * SCALE * SCALE + sub) + c, mask=inside, other=0.0)
    tl.store(grad_matrix + i, slope, mask=inside)
