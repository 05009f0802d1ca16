"""Blending in plain torch: band by band, all Gaussians that reach it at all of its pixels."""

import torch
from torch import Tensor

from bench.cameras import pixel_grid
from methods.gaussians.kernels.blending import LARGEST_ALPHA
from methods.gaussians.kernels.projection import LEAST_ALPHA, Ellipses
from methods.kernels.types import Pixels, joined

BAND = 16  # rows that are blended together, which bounds the memory


def blend(
    ellipses: Ellipses, opacities: Tensor, colours: Tensor, width: int, height: int, stop: float
) -> Pixels:
    order = ellipses.depth.argsort(stable=True)
    bands = []
    for top in range(0, height, BAND):
        rows = min(BAND, height - top)
        y = ellipses.centres[:, 1].detach()
        half = ellipses.extents[:, 1]
        reaching = (half > 0) & (y + half >= top) & (y - half <= top + rows)
        some = order[reaching[order]]
        column, row = pixel_grid(width, rows, opacities.device).to(opacities).unbind(dim=1)
        pixels = torch.stack((column, row + top), dim=1)
        offset = pixels[:, None] - ellipses.centres[some]  # [P, M, 2]
        a, b, c = ellipses.conics[some].unbind(dim=1)
        u, v = offset.unbind(dim=2)
        alpha = opacities[some] * (-(a * u * u + 2 * b * u * v + c * v * v) / 2).exp()
        alpha = torch.where(alpha >= LEAST_ALPHA, alpha.clamp(max=LARGEST_ALPHA), 0)
        through = torch.cat((alpha.new_ones(len(alpha), 1), (1 - alpha).cumprod(dim=1)), dim=1)
        transmittance = through[:, :-1]  # in front of each
        weight = torch.where(transmittance > stop, transmittance * alpha, 0)
        bands.append((weight @ colours[some], weight @ ellipses.depth[some], weight.sum(dim=1)))
    values, depth, alpha = joined(bands)
    return Pixels(values, depth.detach(), alpha)
