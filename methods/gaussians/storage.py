"""Compact storage of Gaussians: every parameter is rounded to levels between its extremes."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from methods.gaussians.model import Gaussians

OUTLIERS = 1e-3
"""Share of the harmonics, at either end, that is clipped: a few outliers make all steps coarse."""


def rounded(gaussians: Gaussians) -> Gaussians:
    """Gaussians as they come back from storage: means in 16 bits, everything else in 8.

    Levels are spread evenly from the least to the largest value of a column. Opacities are stored
    as they are, scales as logarithms, rotations normalised.
    """
    opacities = _levels(gaussians.opacities, 8).clamp(1e-6, 1 - 1e-6)
    rotations = functional.normalize(gaussians.rotations.detach(), dim=1)
    return Gaussians(
        _levels(gaussians.means, 16),
        _levels(gaussians.log_scales, 8),
        _levels(rotations, 8),
        opacities.logit(),
        _levels(gaussians.base, 8, OUTLIERS),
        _levels(gaussians.view, 8, OUTLIERS),
    )


def stored_bytes(gaussians: Gaussians) -> int:
    """Bytes of rounded parameters, and of the two extremes of each column."""
    columns = [parameter.flatten(1) for _, parameter in _columns(gaussians)]
    bits = [16 if name == "means" else 8 for name, _ in _columns(gaussians)]
    values = sum(c.numel() * b // 8 for c, b in zip(columns, bits, strict=True))
    return values + sum(2 * 4 * c.shape[1] for c in columns)


def _columns(gaussians: Gaussians) -> list[tuple[str, Tensor]]:
    return [
        (name, value[:, None] if value.dim() == 1 else value)
        for name, value in gaussians.named_parameters()
    ]


def _levels(values: Tensor, bits: int, outliers: float = 0.0) -> Tensor:
    """`values` [N, ...], each column rounded to 2^bits levels between its extremes."""
    columns = values.detach().flatten(1) if values.dim() > 1 else values.detach()[:, None]
    if not columns.numel():
        return values.detach().clone()
    skipped = int(outliers * len(columns))
    low = columns.kthvalue(1 + skipped, dim=0).values
    high = columns.kthvalue(len(columns) - skipped, dim=0).values
    step = ((high - low) / (2**bits - 1)).clamp(min=torch.finfo(columns.dtype).tiny)
    level = ((columns.clamp(low, high) - low) / step).round()
    return (low + level * step).view_as(values)
