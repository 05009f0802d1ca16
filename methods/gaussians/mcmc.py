"""Densification as sampling (Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte
Carlo").

The number of Gaussians is fixed. Those that have faded are relocated to others, and noise lets the
faint ones explore.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from methods.gaussians.kernels.projection import covariances
from methods.gaussians.model import Gaussians

DEAD = 0.005
"""A Gaussian whose opacity is at most this is dead, and is relocated."""

MOST_COPIES = 51
"""Maximum number of Gaussians in one place after a relocation, as in the release."""

STEEPNESS, FAINT = 100.0, 0.005
"""Noise falls off around the opacity `FAINT` as a sigmoid of this steepness (their Eq. 10)."""


@torch.no_grad()
def relocate(
    gaussians: Gaussians, optimiser: torch.optim.Optimizer, generator: torch.Generator
) -> int:
    """Move dead Gaussians to living ones, drawn in proportion to opacity; return how many moved.

    A living one and its copies get opacities and scales such that together they look as it did
    alone (their Eq. 9). The optimiser's moments of all Gaussians that changed are set to 0.
    """
    opacities = gaussians.opacities
    dead = (opacities <= DEAD).nonzero().squeeze(1)
    alive = (opacities > DEAD).nonzero().squeeze(1)
    if not len(dead) or not len(alive):
        return 0
    drawn = torch.multinomial(opacities[alive], len(dead), replacement=True, generator=generator)
    source = alive[drawn]
    copies = torch.bincount(source, minlength=len(gaussians))[source] + 1
    opacity, shrink = shared_between(opacities[source], copies)
    gaussians.logits[source] = opacity.clamp(DEAD, 1 - 1e-6).logit()
    gaussians.log_scales[source] += shrink.log()[:, None]
    for parameter in gaussians.parameters():
        parameter[dead] = parameter[source]
    changed = torch.cat((dead, source))
    for state in optimiser.state.values():
        for name in ("exp_avg", "exp_avg_sq"):
            state[name][changed] = 0
    return len(dead)


def shared_between(opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity of each of `copies` [N] Gaussians that replace one of `opacities` [N], and the factor
    on its scales (Eq. 9).

    1 - (1 - o_new)^n = o, and the factor keeps the integral of the opacity along a ray through the
    centre.
    """
    copies = copies.clamp(1, MOST_COPIES)
    new = 1 - (1 - opacities.double()) ** (1 / copies)
    total = torch.zeros_like(new)
    for i in range(1, int(copies.max()) + 1):
        terms = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1) for k in range(i)
        )
        total += torch.where(copies >= i, terms, 0.0)
    return new.float(), (opacities / total).float()


@torch.no_grad()
def disturb(gaussians: Gaussians, amount: float, generator: torch.Generator) -> None:
    """Add noise to the means, in the shape of each Gaussian, and more the fainter it is (Eq. 8)."""
    means = gaussians.means
    faintness = torch.sigmoid(STEEPNESS * (FAINT - gaussians.opacities))
    noise = torch.randn(means.shape, generator=generator, device=means.device)
    spread = covariances(gaussians.log_scales.exp(), gaussians.rotations)
    means.add_(amount * (spread @ (faintness[:, None] * noise)[:, :, None]).squeeze(2))
