"""How long a hash table a scene needs: a long one where its pictures show much detail.

A table that is too short blurs a scene, one that is too long takes time in every training step, and
memory.
"""

import math
from dataclasses import asdict

import torch
from torch import Tensor

from bench.types import Scene, Split
from methods.kernels.encode import HashGrid

SHORT, LONG = 17, 19  # log2 T

FINE = 50_000
"""Pixels of detail in a picture from which on a scene needs the long table: docs/log.md."""

CONTRAST = 0.04  # between neighbouring pixels, of 1, from which on they count as detail

PICTURES = 16  # at most so many are looked at


class SuitedGrid(HashGrid):
    """A hash grid whose table is as long as a scene needs it; `log2_table` is not used."""

    def of(self, scene: Scene) -> HashGrid:
        """The grid for `scene`."""
        log2_table = SHORT if detail(scene.splits["train"]) < FINE else LONG
        return HashGrid(**{**asdict(self), "log2_table": log2_table})


def hash_grid(
    *, levels: int, features: int, log2_table: int | None, n_min: int, n_max: int
) -> HashGrid:
    """A hash grid of that shape; `log2_table` None: a `SuitedGrid`."""
    shape = {"levels": levels, "features": features, "n_min": n_min, "n_max": n_max}
    if log2_table is None:
        return SuitedGrid(log2_table=SHORT, **shape)
    return HashGrid(log2_table=log2_table, **shape)


def detail(split: Split) -> float:
    """How many pixels of a picture of `split` show detail, in the mean: matter whose colour differs
    from that of the pixel to the left or above by `CONTRAST` or more in some channel."""
    count = len(split.images)
    chosen = torch.linspace(0, count - 1, min(count, PICTURES)).long().unique()
    return sum(_detailed(split.images[n], split.mask(n)) for n in chosen.tolist()) / len(chosen)


def _detailed(picture: Tensor, mask: Tensor | None) -> int:
    """Number of pixels with detail of `picture` uint8 [H, W, 3 or 4], of those that count."""
    rgb = picture[..., :3].float() / 255
    if mask is not None:
        rgb[~mask] = math.nan  # which differs from nothing
    shown = torch.ones_like(rgb[..., 0], dtype=torch.bool)
    if picture.shape[-1] == 4:
        alpha = picture[..., 3:].float() / 255
        rgb, shown = rgb * alpha, alpha[..., 0] > 0.5
    here = rgb[1:, 1:]
    across, down = (here - rgb[1:, :-1]).abs(), (here - rgb[:-1, 1:]).abs()
    differs = torch.maximum(across, down).amax(dim=-1) >= CONTRAST
    return int((differs & shown[1:, 1:]).sum())
