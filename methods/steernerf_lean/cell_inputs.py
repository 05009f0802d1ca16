"""What the lean network reads of a cell, and how its output becomes the pixels of that cell.

Colours are relative to the background, those of the preceding picture and of the surface relative
to the base, so that empty space is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from methods.steernerf_lean.observation import LeanObservation


@dataclass(frozen=True)
class Layout:
    """Which inputs a network reads."""

    channels: int  # K
    scale: int  # s
    history: bool  # whether it reads the preceding picture

    @property
    def columns(self) -> dict[str, int]:
        """The parts of a row, in this order, and their columns; see `CellInputs`."""
        rest, pixels = self.channels - 3, self.scale**2
        history = {"history": 3 * pixels, "valid": pixels} if self.history else {}
        surface = {"surface": 3 * pixels, "surface opacity": pixels, "surface rest": rest * pixels}
        return {"colour": 3, "opacity": 1, "rest": rest, **history, **surface}

    @property
    def width(self) -> int:
        """Columns of a row."""
        return sum(self.columns.values())

    def split(self, rows: Tensor) -> dict[str, Tensor]:
        """The parts of `rows` [..., width], as views."""
        parts = rows.split(list(self.columns.values()), dim=-1)
        return dict(zip(self.columns, parts, strict=True))


@dataclass(frozen=True)
class CellInputs:
    """The inputs of N cells.

    `base` [N, s^2, 3] are the present colours, bilinearly enlarged with a repeated border; the
    network corrects them. `parts` have the names of `Layout.columns`: present colour [N, 3],
    opacity [N, 1] and rest [N, K - 3]; of each pixel, colour [N, s^2, 3] and validity [N, s^2, 1]
    of the preceding picture, and colour [N, s^2, 3], opacity [N, s^2, 1] and rest [N, s^2, K - 3]
    of the surface. 0 where nothing is known.
    """

    base: Tensor
    parts: dict[str, Tensor]

    @classmethod
    def of(cls, observations: Sequence[LeanObservation], layout: Layout) -> CellInputs:
        """The inputs of all cells; differentiable in the features of frame and surface."""
        each = [_inputs(o, layout) for o in observations]
        if len(each) == 1:
            return each[0]
        parts = {name: torch.cat([x.parts[name] for x in each]) for name in layout.columns}
        return cls(torch.cat([x.base for x in each]), parts)

    def rows(self) -> Tensor:
        """The input of the network, [N, layout.width]."""
        return torch.cat([part.flatten(1) for part in self.parts.values()], dim=1)

    def drawn(self, output: Tensor, matrix: Tensor) -> Tensor:
        """Pixels [N, s^2, 3] = base + correction + share * preceding colour + matrix [opacity *
        colour, opacity, rest of the surface]. `output` are corrections [N, 3 s^2], with history
        followed by logits of the shares [N, s^2]; `matrix` [N, 3 (K + 1)] is that of a cell."""
        parts, pixels = self.parts, self.base.shape[1]
        drawn = self.base + output[:, : 3 * pixels].view_as(self.base)
        if "history" in parts:
            share = output[:, 3 * pixels :, None].sigmoid() * parts["valid"]
            drawn = drawn + share * parts["history"]
        opacity = parts["surface opacity"]
        seen = torch.cat((opacity * parts["surface"], opacity, parts["surface rest"]), dim=-1)
        with torch.autocast(drawn.device.type, enabled=False):
            return torch.baddbmm(drawn, seen, matrix.unflatten(1, (3, -1)).transpose(1, 2))


def _inputs(o: LeanObservation, layout: Layout) -> CellInputs:
    """The inputs of the cells of `o`."""
    less = o.frame.values - o.background
    base = _enlarged(less[..., :3], o.cells, layout.scale)
    present = less.flatten(0, 1).index_select(0, o.cells)
    opacity = o.frame.alpha.flatten().index_select(0, o.cells)
    parts = {"colour": present[:, :3], "opacity": opacity[:, None], "rest": present[:, 3:]}
    if layout.history and o.history is None:
        parts |= {"history": torch.zeros_like(base), "valid": torch.zeros_like(base[..., :1])}
    elif layout.history and o.history is not None:
        values, valid = o.history[0], o.history[1][..., None]
        parts |= {"history": (values - o.background[:3] - base) * valid, "valid": valid}
    less = o.surface.values - functional.pad(o.background, (0, 1))
    rows, index = functional.pad(less, (0, 0, 1, 0)), o.surface.index  # -1 shows a row of 0
    seen = rows.index_select(0, index.flatten() + 1).view(*index.shape, rows.shape[1])
    parts["surface"] = seen[..., :3] - base * (index >= 0)[..., None]
    parts |= {"surface opacity": seen[..., -1:], "surface rest": seen[..., 3:-1]}
    return CellInputs(base, parts)


def _enlarged(colours: Tensor, cells: Tensor, scale: int) -> Tensor:
    """Bilinearly enlarge `colours` [h, w, 3] in `cells`, with a repeated border: [N, s^2, 3]."""
    height, width, _ = colours.shape
    around = torch.arange(-1, 2, device=cells.device)
    row = ((cells // width)[:, None] + around).clamp(0, height - 1)
    column = ((cells % width)[:, None] + around).clamp(0, width - 1)
    near = row[:, :, None] * width + column[:, None]  # [N, 3, 3]
    samples = colours.flatten(0, 1).index_select(0, near.flatten()).view(len(cells), 27)
    taps = _taps(scale).to(samples, non_blocking=True)
    with torch.autocast(samples.device.type, enabled=False):
        return (samples @ taps).view(len(cells), scale**2, 3)


def _taps(scale: int) -> Tensor:
    """Weights [27, 3 s^2] of the colours of the 3 x 3 samples in those of the s x s pixels: one
    large product with a third of its weights not 0 is faster than a small one for each cell."""
    place = (torch.arange(scale) + 0.5) / scale - 0.5
    tent = (1 - (place - torch.tensor((-1.0, 0.0, 1.0))[:, None]).abs()).clamp(min=0)  # [3, s]
    return torch.kron(torch.kron(tent, tent), torch.eye(3))
