"""A scene as 3D Gaussians, its pictures (Kerbl et al. 2023), and how it is stored in few bytes."""

import math
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Camera, Probe
from methods.gaussians.kernels.blending import blend
from methods.gaussians.kernels.projection import project_gaussians
from methods.kernels.shade import shade
from methods.kernels.types import Pixels

Y00 = 1 / math.sqrt(4 * math.pi)  # the first spherical harmonic, a constant

OUTLIERS = 1e-3
"""Share of the harmonics, at either end, that is clipped: a few outliers make all steps coarse."""


class Gaussians(nn.Module):
    """N Gaussians."""

    def __init__(
        self,
        means: Tensor,  # [N, 3] centres, scene units
        log_scales: Tensor,  # [N, 3] logarithms of the standard deviations along their axes
        rotations: Tensor,  # [N, 4] quaternions (w, x, y, z), not normalised
        logits: Tensor,  # [N] of the opacity at the centre
        base: Tensor,  # [N, 1, 3] coefficients of the first spherical harmonic
        view: Tensor,  # [N, C - 1, 3] of the others, in the order of `methods.kernels.spherical`
    ) -> None:
        super().__init__()
        self.means = nn.Parameter(means)
        self.log_scales = nn.Parameter(log_scales)
        self.rotations = nn.Parameter(rotations)
        self.logits = nn.Parameter(logits)
        self.base = nn.Parameter(base)
        self.view = nn.Parameter(view)

    @classmethod
    def at(
        cls, points: Tensor, colours: Tensor, scales: Tensor, opacity: float, degree: int
    ) -> Self:
        """Make round Gaussians at `points` [N, 3], with standard deviations `scales` [N] and
        `colours` [N, 3] that are the same from all sides."""
        count = len(points)
        return cls(
            points.clone(),
            scales.log()[:, None].repeat(1, 3),
            torch.tensor([1.0, 0.0, 0.0, 0.0]).to(points).repeat(count, 1),
            points.new_full((count,), math.log(opacity / (1 - opacity))),
            ((colours - 0.5) / Y00)[:, None],
            points.new_zeros(count, (degree + 1) ** 2 - 1, 3),
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacities(self) -> Tensor:
        """[N] at the centres, in (0, 1)."""
        return self.logits.sigmoid()

    def render(self, camera: Camera, stop: float, probe: Probe, backend: str = "auto") -> Pixels:
        """Render the pixels of `camera`, row by row, not composited on a background; differentiable
        in all parameters, but for the change of a colour with the direction of the mean."""
        with probe.stage("project"):
            opacities = self.opacities
            shape = self.means, self.log_scales.exp(), self.rotations
            ellipses = project_gaussians(*shape, opacities, camera, backend=backend)
        probe.count("gaussians", (ellipses.extents[:, 0] > 0).sum(), len(self))
        with probe.stage("shade"):
            towards = functional.normalize(self.means.detach() - camera.centre, dim=1)
            harmonics = torch.cat((self.base, self.view), dim=1)
            colours = (shade(harmonics, towards, backend=backend) + 0.5).clamp(min=0)
        with probe.stage("blend"):
            return blend(ellipses, opacities, colours, *camera.size, stop=stop, backend=backend)


def rounded(gaussians: Gaussians) -> Gaussians:
    """Gaussians as they come back from storage: means in 16 bits, everything else in 8; opacities
    as they are, scales as logarithms, rotations normalised. Flat ones get the least thickness."""
    opacities = _levels(gaussians.opacities, 8).clamp(1e-6, 1 - 1e-6)
    log_scales = gaussians.log_scales.detach()
    thinnest = log_scales[log_scales.isfinite()].min()
    return Gaussians(
        _levels(gaussians.means, 16),
        _levels(log_scales.clamp(min=thinnest), 8),
        _levels(functional.normalize(gaussians.rotations, dim=1), 8),
        opacities.logit(),
        _levels(gaussians.base, 8, OUTLIERS),
        _levels(gaussians.view, 8, OUTLIERS),
    )


def stored_bytes(gaussians: Gaussians) -> int:
    """Bytes of rounded parameters, and of the two extremes of each column."""
    total = 0
    for name, values in gaussians.named_parameters():
        width = 2 if name == "means" else 1
        total += (len(values) * width + 2 * 4) * (values.numel() // len(values))
    return total


def _levels(values: Tensor, bits: int, outliers: float = 0.0) -> Tensor:
    """`values` [N, ...], each column rounded to 2^bits levels, evenly between its extremes."""
    columns = values.detach().reshape(len(values), math.prod(values.shape[1:]))
    if not columns.numel():
        return values.detach().clone()
    skipped = int(outliers * len(columns))
    low = columns.kthvalue(1 + skipped, dim=0).values
    high = columns.kthvalue(len(columns) - skipped, dim=0).values
    step = ((high - low) / (2**bits - 1)).clamp(min=torch.finfo(columns.dtype).tiny)
    level = ((columns.clamp(low, high) - low) / step).round()
    return (low + level * step).view_as(values)
