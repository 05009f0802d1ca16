"""A scene as 3D Gaussians, and its pictures (Kerbl et al. 2023)."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Camera, Probe
from methods.gaussians.kernels.blending import blend
from methods.gaussians.kernels.projection import project_gaussians
from methods.kernels.spherical import shade
from methods.kernels.types import Pixels

Y00 = 1 / math.sqrt(4 * math.pi)
"""The first spherical harmonic, a constant."""


class Gaussians(nn.Module):
    """N Gaussians.

    Attributes:
        means: [N, 3] centres, scene units.
        log_scales: [N, 3] logarithms of the standard deviations along their axes.
        rotations: [N, 4] quaternions (w, x, y, z), not normalised.
        logits: [N] logits of the opacity at the centre.
        base: [N, 1, 3] coefficients of the first spherical harmonic.
        view: [N, C - 1, 3] those of the others, in the order of `methods.kernels.spherical`.
    """

    def __init__(
        self,
        means: Tensor,
        log_scales: Tensor,
        rotations: Tensor,
        logits: Tensor,
        base: Tensor,
        view: Tensor,
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
    ) -> Gaussians:
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
        """Render the pixels of `camera`, row by row, not composited on a background.

        Differentiable in all parameters, except for the change of a colour with the direction in
        which the mean is seen.
        """
        with probe.stage("project"):
            opacities = self.opacities
            ellipses = project_gaussians(
                self.means,
                self.log_scales.exp(),
                self.rotations,
                opacities,
                camera,
                backend=backend,
            )
        probe.count("gaussians", (ellipses.extents[:, 0] > 0).sum(), len(self))
        with probe.stage("shade"):
            towards = functional.normalize(self.means.detach() - camera.c2w[:, 3], dim=1)
            harmonics = torch.cat((self.base, self.view), dim=1)
            colours = (shade(harmonics, towards, backend=backend) + 0.5).clamp(min=0)
        with probe.stage("blend"):
            size = camera.width, camera.height
            return blend(ellipses, opacities, colours, *size, stop=stop, backend=backend)
