"""Range reduction by a window of depths, with a fallback where the window misses the surface.

Not in the paper, whose interval leaves holes where the reprojected depth is of another surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Camera, Probe, Rays
from methods.kernels.types import Occupancy, Pixels
from methods.rendering.compaction import kept_indices
from methods.rendering.field import Field
from methods.rendering.frame import Render
from methods.rendering.rays import render_rays
from methods.rendering.sampling import FAINT, Sampling
from methods.steernerf.buffer import Cloud
from methods.steernerf.options import Reprojection
from methods.steernerf.range_reduction import at_pixels

KEPT_ALPHA = 0.95
"""Share of the expected opacity at which a ray counts as having found the surface."""

EDGE = 2.0
"""A neighbourhood whose depths differ by more than this many epsilons is a depth edge."""


@dataclass(frozen=True)
class DepthPrior:
    """The depth prior that a preceding frame gives for a view of h x w pixels.

    Attributes:
        window: [h, w, 2] nearest and farthest z-depth worth sampling; [0, inf) if unknown.
        alpha: [h, w] expected opacity; 0 where no point is near.
    """

    window: Tensor
    alpha: Tensor


def depth_prior(
    cloud: Cloud, camera: Camera, epsilon: float, how: Reprojection, backend: str
) -> DepthPrior:
    """The depth prior of `camera`, a low-resolution one, from the points of `cloud` around each
    pixel; unknown where no point is near, or at a depth edge."""
    index, depth = cloud.splat(camera, how, backend)
    near = -_highest(-at_pixels(depth, index, torch.inf))
    far = _highest(at_pixels(depth, index, -torch.inf))
    alpha = _highest(at_pixels(cloud.alpha, index, 0.0))
    known = (alpha > 0) & (far - near < EDGE * epsilon)
    window = torch.stack(
        (torch.where(known, near - epsilon, 0), torch.where(known, far + epsilon, torch.inf)),
        dim=-1,
    )
    return DepthPrior(window, alpha)


def depths_around(depth: Tensor, epsilon: float) -> Tensor:
    """Nearest and farthest z-depth [h, w, 2] in the 3 x 3 neighbourhoods of `depth` [h, w], widened
    by `epsilon`; [0, inf) where no depth is finite."""
    near = -_highest(-depth)
    far = _highest(torch.where(depth.isfinite(), depth, -torch.inf))
    known = near.isfinite()
    ends = torch.where(known, near - epsilon, 0), torch.where(known, far + epsilon, torch.inf)
    return torch.stack(ends, dim=-1)


def _highest(image: Tensor) -> Tensor:
    """Largest value of each pixel's 3 x 3 neighbourhood."""
    return functional.max_pool2d(image[None], 3, stride=1, padding=1)[0]


def within(
    field: Field, occupancy: Occupancy, probe: Probe, how: Sampling, prior: DepthPrior
) -> Render:
    """Make the argument `render` of `rendering.frame.render_frame` that samples each ray in its
    window of `prior`, and behind it if the ray does not reach the expected opacity."""

    def render(seen: Tensor, rays: Rays) -> Pixels:
        window, expected = prior.window.view(-1, 2)[seen], prior.alpha.flatten()[seen]
        narrow = window[:, 1].isfinite()
        inside = kept_indices(narrow)
        expected, near = expected[inside], torch.where(narrow[:, None], window, 0)[inside]
        # A stricter faint limit: rays that go on would lack the faint samples in front.
        loose = Sampling(how.step, max(how.stop, 1 - KEPT_ALPHA), near, faint=FAINT * how.stop)
        first = render_rays(field, rays.take(inside), occupancy, probe, loose)
        enough = narrow[inside] & (first.alpha >= KEPT_ALPHA * expected)
        # Scale to the expected opacity, as if the rest looked like what was found.
        more = torch.where(enough & (first.alpha < expected), expected / first.alpha, 1)
        canvas = Pixels.blank(len(seen), first.values.shape[1], field.device)
        canvas.put(
            inside, Pixels(first.values * more[:, None], first.depth_sum * more, first.alpha * more)
        )
        unfinished = torch.ones_like(narrow)
        unfinished[inside] = ~enough
        rest = kept_indices(unfinished)
        begin, end = torch.where(narrow, window[:, 1], 0), torch.where(unfinished, torch.inf, 0)
        behind = how.within(torch.stack((begin, end), dim=1)[rest])
        carry = canvas.take(rest)
        canvas.put(rest, render_rays(field, rays.take(rest), occupancy, probe, behind, carry))
        return canvas

    return render
