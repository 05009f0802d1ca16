"""Rows and pixels of cells with numba: one cell at a time, one pass over its inputs.

Gradients of data shared by cells (samples, points) are summed by a single thread, which makes them
repeatable. More threads would gain little: reading the summands takes as long as adding them.
"""

from __future__ import annotations

import torch
from numba import njit, prange
from torch import Tensor

from methods.kernels.cpu import f32, sigmoid
from methods.steernerf_lean.kernels.space_to_depth import TAPS, CellInputs, Layout, Pair

FAST = {"contract"}


def space_to_depth(inputs: CellInputs, layout: Layout, taps: Tensor, count: int) -> Pair:
    """See `methods.steernerf_lean.kernels.space_to_depth.space_to_depth`."""
    _check_float32(inputs.values)
    frame = inputs.values, inputs.alpha, inputs.background, inputs.cells, taps
    points = [part for pair in inputs.preceding for part in pair]
    layers = inputs.history, *(inputs.surface or (None, None)), *points
    return _SpaceToDepth.apply(layout, count, *frame, *layers)


def depth_to_space(
    base: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None, layout: Layout
) -> Tensor:
    """See `methods.steernerf_lean.kernels.space_to_depth.depth_to_space`."""
    _check_float32(base)
    if matrix is None:
        matrix = base.new_zeros(len(rows), 0)
    return _DepthToSpace.apply(layout, base, rows, output.float(), matrix.float())


def _check_float32(x: Tensor) -> None:
    if x.dtype != torch.float32:
        raise ValueError(f"backend 'cpu' takes float32, got {x.dtype}: use backend='reference'")


class _SpaceToDepth(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx,
        layout,
        count,
        values,
        alpha,
        background,
        cells,
        taps,
        history,
        surface,
        at_surface,
        *points,
    ):
        values, alpha, background = (x.detach().contiguous() for x in (values, alpha, background))
        scale, begins, width = layout.scale, layout.begins, values.shape[1]
        base = torch.empty(len(cells), scale**2, 3)
        rows = torch.empty(count, layout.width)
        rows[len(cells) :] = 0
        frame = (values.flatten(0, 1).numpy(), alpha.view(-1).numpy(), background.numpy())
        _present(*frame, width, cells.numpy(), taps.numpy(), base.numpy(), rows.numpy())
        pairs = list(zip(points[::2], points[1::2], strict=True))
        for age in range(layout.frames):
            begin = begins[f"preceding {age}"]
            if age >= len(pairs):
                rows[:, begin : begin + scale**2 * (layout.channels + 1)] = 0
                continue
            features, index = (x.detach().contiguous() for x in pairs[age])
            where = (index.numpy(), cells.numpy(), width, scale, begin)
            _check(_preceding(features.numpy(), background.numpy(), *where, rows.numpy()), features)
        if layout.history:
            begin = begins["history"]
            if history is None:
                rows[:, begin : begin + 4 * scale**2] = 0
            else:
                recent, valid = (x.contiguous().numpy() for x in history)
                _history(recent, valid, background.numpy(), base.numpy(), begin, rows.numpy())
        if layout.surface:
            begin = begins["surface"]
            if surface is None:
                rows[:, begin:] = 0
            else:
                features = surface.detach().contiguous()
                index = at_surface.contiguous()
                arrays = (x.numpy() for x in (features, background, index, base))
                _check(_surface(*arrays, begin, rows.numpy()), features)
        ctx.layout, ctx.shape, ctx.counts = layout, values.shape, [len(x) for x in points[::2]]
        ctx.surfaces = None if surface is None else len(surface)
        valid = None if history is None else history[1].contiguous()
        ctx.save_for_backward(cells, taps, valid, at_surface, *points[1::2])
        return base, rows

    @staticmethod
    def backward(ctx, grad_base, grad_rows):
        layout, (cells, taps, valid, at_surface, *indices) = ctx.layout, ctx.saved_tensors
        height, width, channels = ctx.shape
        grad_base, grad_rows = grad_base.contiguous().clone(), grad_rows.contiguous()
        rows, begins = grad_rows.numpy(), layout.begins
        if valid is not None:
            _history_back(valid.numpy(), rows, begins["history"], grad_base.numpy())
        grad_surface = None
        if ctx.surfaces is not None:
            grad_surface = torch.zeros(ctx.surfaces, channels + 1)
            grads = (grad_base.numpy(), grad_surface.numpy())
            _surface_back(at_surface.contiguous().numpy(), rows, begins["surface"], *grads)
        grad_points: list[Tensor | None] = []
        for age, index in enumerate(indices):
            grad = None
            if ctx.needs_input_grad[10 + 2 * age]:
                grad = torch.zeros(ctx.counts[age], channels)
                where = (cells.numpy(), width, layout.scale, rows, begins[f"preceding {age}"])
                _preceding_back(index.contiguous().numpy(), *where, grad.numpy())
            grad_points += [grad, None]
        grad_values, grad_alpha = torch.zeros(height * width, channels), torch.zeros(height, width)
        frame = (grad_values.numpy(), grad_alpha.view(-1).numpy())
        _present_back(rows, grad_base.numpy(), height, width, cells.numpy(), taps.numpy(), *frame)
        frame_grads = (grad_values.view(height, width, channels), grad_alpha)
        return None, None, *frame_grads, None, None, None, None, grad_surface, None, *grad_points


class _DepthToSpace(torch.autograd.Function):
    @staticmethod
    def forward(ctx, layout, base, rows, output, matrix):
        parts = [x.detach().contiguous() for x in (base, rows, output, matrix)]
        pixels = torch.empty_like(base)
        _pixels(*(x.numpy() for x in parts), *_columns(layout), pixels.numpy())
        ctx.layout = layout
        ctx.save_for_backward(*parts[1:])
        return pixels

    @staticmethod
    def backward(ctx, grad):
        rows, output, matrix = ctx.saved_tensors
        grad = grad.contiguous()
        grads = [torch.zeros_like(x) for x in (rows, output, matrix)]
        arrays = (x.numpy() for x in (rows, output, matrix, grad, *grads))
        _pixels_back(*arrays, *_columns(ctx.layout))
        return None, grad, *grads


def _columns(layout: Layout) -> tuple[int, int, int]:
    """K, and the first columns of history and surface, -1 if absent."""
    begins = layout.begins
    return layout.channels, begins.get("history", -1), begins.get("surface", -1)


def _check(wrong: int, values: Tensor) -> None:
    if wrong:
        raise ValueError(
            f"index: expected -1 to {len(values) - 1}, got {wrong} entries that are not"
        )


@njit(cache=True)
def _put(row, column, values, background, opacity):
    """Write features minus background from `column` on, with `opacity` after the colours."""
    for c in range(3):
        row[column + c] = values[c] - background[c]
    row[column + 3] = opacity
    for c in range(3, len(background)):
        row[column + 1 + c] = values[c] - background[c]


@njit(cache=True)
def _nearest(row, column, tap, height, width):
    """Index of the sample at tap 0 to 8 of the 3 x 3 around (row, column), border repeated."""
    y = min(max(row + tap // 3 - 1, 0), height - 1)
    x = min(max(column + tap % 3 - 1, 0), width - 1)
    return y * width + x


@njit(cache=True, parallel=True, fastmath=FAST)
def _present(values, alpha, background, width, cells, taps, base, rows):
    height, pixels = len(alpha) // width, len(taps)
    for n in prange(len(cells)):
        cell = cells[n]
        _put(rows[n], 0, values[cell], background, alpha[cell])
        base[n] = 0
        for tap in range(TAPS):
            near = _nearest(cell // width, cell % width, tap, height, width)
            for c in range(3):
                colour = values[near, c] - background[c]
                for sub in range(pixels):
                    base[n, sub, c] += taps[sub, tap] * colour


@njit(cache=True, parallel=True)
def _preceding(values, background, index, cells, width, scale, begin, rows):
    features, wrong = len(background) + 1, 0
    for n in prange(len(cells)):
        top, left = cells[n] // width * scale, cells[n] % width * scale
        for sub in range(scale * scale):
            column = begin + sub * features
            point = index[top + sub // scale, left + sub % scale]
            if 0 <= point < len(values):
                _put(rows[n], column, values[point], background, f32(1))
            else:
                rows[n, column : column + features] = 0
                wrong += point != -1
    return wrong


@njit(cache=True, parallel=True)
def _history(recent, valid, background, base, begin, rows):
    for n in prange(len(base)):
        for sub in range(base.shape[1]):
            known = valid[n, sub]
            for c in range(3):
                less = recent[n, sub, c] - background[c] - base[n, sub, c]
                rows[n, begin + 4 * sub + c] = less * known
            rows[n, begin + 4 * sub + 3] = known


@njit(cache=True, parallel=True)
def _surface(values, background, index, base, begin, rows):
    features, wrong = values.shape[1], 0
    for n in prange(len(base)):
        for sub in range(base.shape[1]):
            column, point = begin + sub * features, index[n, sub]
            if 0 <= point < len(values):
                opacity = values[point, features - 1]
                _put(rows[n], column, values[point], background, opacity)
                for c in range(3):
                    rows[n, column + c] -= base[n, sub, c]
            else:
                rows[n, column : column + features] = 0
                wrong += point != -1
    return wrong


@njit(cache=True, parallel=True)
def _history_back(valid, grad_rows, begin, grad_base):
    for n in prange(len(valid)):
        for sub in range(valid.shape[1]):
            for c in range(3):
                grad_base[n, sub, c] -= valid[n, sub] * grad_rows[n, begin + 4 * sub + c]


@njit(cache=True)
def _surface_back(index, grad_rows, begin, grad_base, grad):
    features = grad.shape[1]
    for n in range(len(index)):
        for sub in range(index.shape[1]):
            column, point = begin + sub * features, index[n, sub]
            if point >= 0:
                for c in range(3):
                    grad_base[n, sub, c] -= grad_rows[n, column + c]
                    grad[point, c] += grad_rows[n, column + c]
                grad[point, features - 1] += grad_rows[n, column + 3]
                for c in range(3, features - 1):
                    grad[point, c] += grad_rows[n, column + 1 + c]


@njit(cache=True)
def _preceding_back(index, cells, width, scale, grad_rows, begin, grad):
    channels = grad.shape[1]
    for n in range(len(cells)):
        top, left = cells[n] // width * scale, cells[n] % width * scale
        for sub in range(scale * scale):
            column = begin + sub * (channels + 1)
            point = index[top + sub // scale, left + sub % scale]
            if point >= 0:
                for c in range(channels):
                    grad[point, c] += grad_rows[n, column + (c if c < 3 else c + 1)]


@njit(cache=True)
def _present_back(grad_rows, grad_base, height, width, cells, taps, grad_values, grad_alpha):
    channels, pixels = grad_values.shape[1], len(taps)
    for n in range(len(cells)):
        cell = cells[n]
        for c in range(channels):
            grad_values[cell, c] += grad_rows[n, c if c < 3 else c + 1]
        grad_alpha[cell] += grad_rows[n, 3]
        for tap in range(TAPS):
            near = _nearest(cell // width, cell % width, tap, height, width)
            for sub in range(pixels):
                weight = taps[sub, tap]
                for c in range(3):
                    grad_values[near, c] += weight * grad_base[n, sub, c]


@njit(cache=True, parallel=True, fastmath=FAST)
def _pixels(base, rows, output, matrix, channels, history, surface, pixels):
    features = channels + 1
    outputs = output.shape[1] // base.shape[1]
    for n in prange(len(base)):
        for sub in range(base.shape[1]):
            for c in range(3):
                pixels[n, sub, c] = base[n, sub, c] + output[n, sub * outputs + c]
            if history >= 0:
                column = history + 4 * sub
                share = sigmoid(output[n, sub * outputs + 3]) * rows[n, column + 3]
                for c in range(3):
                    pixels[n, sub, c] += share * rows[n, column + c]
            if surface >= 0:
                column = surface + features * sub
                opacity = rows[n, column + 3]
                for c in range(3):
                    total = f32(0)
                    for i in range(features):
                        weight = opacity if i < 3 else f32(1)
                        total += matrix[n, c * features + i] * weight * rows[n, column + i]
                    pixels[n, sub, c] += total


@njit(cache=True, parallel=True, fastmath=FAST)
def _pixels_back(
    rows, output, matrix, grad, grad_rows, grad_output, grad_matrix, channels, history, surface
):
    features = channels + 1
    outputs = output.shape[1] // grad.shape[1]
    for n in prange(len(grad)):
        for sub in range(grad.shape[1]):
            for c in range(3):
                grad_output[n, sub * outputs + c] = grad[n, sub, c]
            if history >= 0:
                column = history + 4 * sub
                share, known = sigmoid(output[n, sub * outputs + 3]), rows[n, column + 3]
                along = f32(0)
                for c in range(3):
                    grad_rows[n, column + c] = share * known * grad[n, sub, c]
                    along += grad[n, sub, c] * rows[n, column + c]
                grad_rows[n, column + 3] = share * along
                grad_output[n, sub * outputs + 3] = share * (f32(1) - share) * known * along
            if surface >= 0:
                column = surface + features * sub
                opacity = rows[n, column + 3]
                for i in range(features):
                    value = rows[n, column + i]
                    weight = opacity if i < 3 else f32(1)
                    along = f32(0)
                    for c in range(3):
                        along += matrix[n, c * features + i] * grad[n, sub, c]
                        grad_matrix[n, c * features + i] += weight * value * grad[n, sub, c]
                    grad_rows[n, column + i] += weight * along
                    if i < 3:
                        grad_rows[n, column + 3] += value * along
