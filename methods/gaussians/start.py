"""Initial Gaussians: on the surfaces of a trained field, or anywhere."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial import KDTree
from torch import Tensor

from bench.types import NullProbe, Scene
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import TrainedField
from methods.rendering.frame import render_rays

SOLID = 0.5
"""Opacity above which a ray counts as ending at a surface."""

NEIGHBOURS = 3


def on_surfaces(
    trained: TrainedField, scene: Scene, count: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Choose `count` points where rays of random training pixels end, and their colours: [count, 3]
    each.

    If the pictures show too little matter, points are taken more than once.
    """
    field = trained.field
    batches = PixelBatches(scene.splits["train"], field.device)
    points: list[Tensor] = []
    colours: list[Tensor] = []
    for _ in range(64):  # too few if less than 1/64 of the pixels show matter
        rays, _ = batches.draw(count, generator)
        pixels = render_rays(field, rays, trained.occupancy, NullProbe(), trained.sampling)
        hit = pixels.alpha > SOLID
        depth = pixels.depth_sum[hit] / pixels.alpha[hit]
        points.append(rays.origins[hit] + depth[:, None] * rays.directions[hit])
        colours.append(pixels.values[hit, :3] / pixels.alpha[hit, None])
        if sum(map(len, points)) >= count:
            break
    found, shades = torch.cat(points), torch.cat(colours)
    if not len(found):
        return anywhere(scene, count, generator)
    # Evenly spread, because rays are drawn picture by picture.
    index = torch.arange(count, device=found.device) * len(found) // count
    return found[index], shades[index].clamp(0, 1)


def anywhere(scene: Scene, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw `count` points uniformly inside the bounds of `scene`, with random colours."""
    low, high = scene.bounds.to(generator.device)
    unit = torch.rand(2, count, 3, generator=generator, device=generator.device)
    return low + unit[0] * (high - low), unit[1]


def spacing(points: Tensor) -> Tensor:
    """Root mean square distance [N] of each point from its nearest neighbours, more than 0."""
    if len(points) <= NEIGHBOURS:
        return torch.full_like(points[:, 0], 0.01)
    places = points.cpu().numpy()
    distances, _ = KDTree(places).query(places, NEIGHBOURS + 1, workers=torch.get_num_threads())
    mean = np.sqrt(np.square(distances[:, 1:]).mean(axis=1))
    return torch.from_numpy(mean).to(points).clamp(min=1e-5)
