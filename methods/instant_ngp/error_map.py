"""Where the training pictures are still rendered wrong, so that more rays go there."""

from __future__ import annotations

import torch
from torch import Tensor

from methods.instant_ngp.pixels import one_from_each

RUN = 128
"""Consecutive pixels that share one estimate of an error: with the numbers of `PixelBatches`, they
mostly lie in 16 rows of 8."""

REFRESHED = 16
"""Steps after which the chances of the runs follow their estimates: they change slowly, and summing
up those of half a million runs takes longer than drawing from them."""

UNSEEN = 0.1
"""Estimate for a run that no ray has met yet: about that of an untrained field."""


class ErrorMap:
    """Running estimates of the squared error of each run of pixels.

    A run is drawn in proportion to the root of its error, its root mean square error, to which the
    gradients of its pixels are proportional. The chances are not made up for by weights: the loss
    then counts wrong pixels more, and has less noise.

    Args:
        pixels: number of pixels of all pictures.

    Attributes:
        errors: [T] mean squared error of each run; each new pixel counts as much as the estimate.
        ends: [T] sum of the chances of each run and all before it, as last refreshed.
    """

    def __init__(self, pixels: int, device: torch.device) -> None:
        self._pixels = pixels
        self.errors = torch.full((-(-pixels // RUN),), UNSEEN, device=device)
        self._met = torch.ones_like(self.errors)  # 1, plus the pixels met while `learn` runs
        self.refresh()

    def refresh(self) -> None:
        """Let the chances follow the estimates."""
        self.ends = self.errors.sqrt().cumsum(0, dtype=torch.float64)

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Draw the numbers [count] of pixels, in the order of their runs."""
        device, ends = self.errors.device, self.ends
        places = one_from_each(count, generator, device) * ends[-1]
        run = torch.searchsorted(ends, places).clamp(max=len(ends) - 1)
        within = torch.randint(RUN, (count,), generator=generator, device=device)
        return (run * RUN + within).clamp(max=self._pixels - 1)

    def learn(self, pixels: Tensor, errors: Tensor) -> None:
        """Update the estimates with the squared `errors` [R] of some `pixels` [R]."""
        run = pixels // RUN
        self._met.index_add_(0, run, torch.ones_like(errors))
        self.errors.index_add_(0, run, errors)
        means = self.errors.index_select(0, run) / self._met.index_select(0, run)
        self.errors.index_copy_(0, run, means)  # a run that appears twice has the same mean twice
        self._met.index_fill_(0, run, 1)
