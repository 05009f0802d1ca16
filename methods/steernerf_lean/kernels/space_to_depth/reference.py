"""Rows and pixels of cells in plain torch, any dtype and device."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from methods.steernerf_lean.kernels.space_to_depth import CellInputs, Layout, Pair


def space_to_depth(inputs: CellInputs, layout: Layout, taps: Tensor, count: int) -> Pair:
    """See `methods.steernerf_lean.kernels.space_to_depth.space_to_depth`."""
    values, background, cells = inputs.values, inputs.background, inputs.cells
    pixels, missing = layout.scale**2, layout.frames - len(inputs.preceding)
    base = _enlarged(values[..., :3] - background[:3], cells, taps)
    present = values.flatten(0, 1)[cells] - background
    parts = [_with_opacity(present, inputs.alpha.flatten()[cells, None])]
    for points, index in inputs.preceding:
        less = points - background
        features = _with_opacity(less, torch.ones_like(less[:, :1]))
        parts.append(_shown(features, _in_cells(index, cells, layout.scale)))
    parts += [base.new_zeros(len(cells), pixels * (layout.channels + 1))] * missing
    if layout.history:
        if inputs.history is None:
            parts.append(base.new_zeros(len(cells), pixels * 4))
        else:
            picture, valid = inputs.history[0], inputs.history[1][..., None]
            recent = (picture - background[:3] - base) * valid
            parts.append(torch.cat((recent, valid), dim=-1))
    if layout.surface:
        if inputs.surface is None:
            parts.append(base.new_zeros(len(cells), pixels * (layout.channels + 1)))
        else:
            points, index = inputs.surface
            features = _shown(_with_opacity(points[:, :-1] - background, points[:, -1:]), index)
            less = base * (index >= 0)[..., None]
            parts.append(features - functional.pad(less, (0, layout.channels - 2)))
    rows = torch.cat([part.flatten(start_dim=1) for part in parts], dim=1)
    return base, functional.pad(rows, (0, 0, 0, count - len(rows)))


def depth_to_space(
    base: Tensor, rows: Tensor, output: Tensor, matrix: Tensor | None, layout: Layout
) -> Tensor:
    """See `methods.steernerf_lean.kernels.space_to_depth.depth_to_space`."""
    pixels, features = layout.scale**2, layout.channels + 1
    rows, output = rows[: len(base)], output[: len(base)]
    out = output.unflatten(1, (pixels, -1))
    shown = base + out[..., :3]
    if layout.history:
        begin = layout.begins["history"]
        recent = rows[:, begin : begin + 4 * pixels].unflatten(1, (pixels, 4))
        shown = shown + (out[..., 3:].sigmoid() * recent[..., 3:]) * recent[..., :3]
    if matrix is not None:
        begin = layout.begins["surface"]
        surface = rows[:, begin : begin + features * pixels].unflatten(1, (pixels, features))
        weighted = torch.cat((surface[..., :3] * surface[..., 3:4], surface[..., 3:]), dim=-1)
        matrix = matrix[: len(base)].unflatten(1, (3, features))
        shown = shown + weighted @ matrix.transpose(1, 2)
    return shown


def _enlarged(colours: Tensor, cells: Tensor, taps: Tensor) -> Tensor:
    """Upsample `colours` [h, w, 3] to the pixels of `cells`: [N, s^2, 3].

    A pixel is the mean of the 3 x 3 samples around its cell with weights `taps` [s^2, 9].
    """
    height, width, _ = colours.shape
    around = torch.arange(-1, 2, device=cells.device)
    row = (cells // width)[:, None] + around.repeat_interleave(3)
    column = (cells % width)[:, None] + around.repeat(3)
    near = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)  # [N, 9]
    samples = colours.flatten(0, 1)[near].transpose(1, 2).flatten(0, 1)  # [3 N, 9]
    return (samples @ taps.T).view(-1, 3, len(taps)).transpose(1, 2)


def _in_cells(image: Tensor, cells: Tensor, scale: int) -> Tensor:
    """The pixels of `image` [h s, w s] in `cells`, [N, s^2]."""
    height, width = (side // scale for side in image.shape)
    blocks = image.view(height, scale, width, scale).transpose(1, 2)
    return blocks[cells // width, cells % width].flatten(1)


def _shown(values: Tensor, index: Tensor) -> Tensor:
    """Rows of `values` at `index`, zeros where it is -1."""
    # Checked only on a CPU; for a GPU the host would have to wait.
    wrong = (index < -1) | (index >= len(values))
    if index.device.type == "cpu" and wrong.any():
        raise ValueError(
            f"index: expected -1 to {len(values) - 1}, got {int(wrong.sum())} entries that are not"
        )
    return functional.pad(values, (0, 0, 0, 1))[index.long()]


def _with_opacity(values: Tensor, opacity: Tensor) -> Tensor:
    """Insert `opacity` [N, 1] after the colours of `values` [N, K]."""
    return torch.cat((values[:, :3], opacity, values[:, 3:]), dim=1)
