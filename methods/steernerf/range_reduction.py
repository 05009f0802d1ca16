"""Range reduction: where a preceding depth says that a ray should look (SteerNeRF Eq. 6 to 8)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Camera, Probe, Rays
from methods.instant_ngp.field import HashField
from methods.kernels.composite import STOP, Pixels
from methods.kernels.march import Occupancy
from methods.rendering.batch import FeatureFrame, rays_at_matter
from methods.rendering.occupancy import STEP
from methods.rendering.rays import FAINT, render_rays
from methods.steernerf.buffer import Cloud, Reprojection

KEPT_ALPHA = 0.95
"""Share of the expected opacity at which a ray has found what was to be expected."""

EDGE = 2.0
"""Depths of a neighbourhood that differ by more than this many epsilons are those of an edge."""


@dataclass(frozen=True)
class RangeReduction:
    """Where along a ray to look for a surface, given the newest preceding frame.

    Attributes:
        mode: "off": everywhere. "paper": within `epsilon` of the depth reprojected onto the pixel,
            whatever is found there (Eq. 8). "window": within `epsilon` of the depths reprojected
            onto its 3 x 3 neighbourhood, until the ray has the opacity they had; a ray that does
            not reach it looks behind the window as well, and one at a depth edge everywhere.
        epsilon: scene units along z.
    """

    mode: Literal["off", "paper", "window"] = "window"
    epsilon: float = 0.03

    def __post_init__(self) -> None:
        if not self.epsilon > 0:
            raise ValueError(f"range.epsilon: expected more than 0, got {self.epsilon}")


@dataclass(frozen=True)
class Evidence:
    """What a preceding frame says of a view of h x w pixels.

    Attributes:
        window: [h, w, 2] nearest and farthest z-depth worth looking at; [0, inf) if unknown.
        alpha: [h, w] the opacity to expect; 0 if unknown.
        binding: nothing else is looked at, even if there is less in the windows than expected.
    """

    window: Tensor
    alpha: Tensor
    binding: bool


def evidence(
    cloud: Cloud, camera: Camera, options: RangeReduction, reprojection: Reprojection, backend: str
) -> Evidence:
    """What `cloud` tells of the depths that `camera`, a low-resolution one, will see."""
    index, depth = cloud.land(camera, reprojection, backend)
    known = index >= 0
    near, far = landed(depth, index, torch.inf), landed(depth, index, -torch.inf)
    alpha = landed(cloud.alpha, index, 0.0)
    if options.mode == "window":
        near, far, alpha = -_highest(-near), _highest(far), _highest(alpha)
        known = (alpha > 0) & (far - near < EDGE * options.epsilon)
    window = torch.stack(
        (
            torch.where(known, near - options.epsilon, 0),
            torch.where(known, far + options.epsilon, torch.inf),
        ),
        dim=-1,
    )
    return Evidence(window, alpha, binding=options.mode == "paper")


def depths_around(depth: Tensor, epsilon: float) -> Tensor:
    """[h, w, 2] nearest and farthest z-depth within `epsilon` of those of the 3 x 3 neighbourhood
    in `depth` [h, w]; [0, inf) where none of them is finite."""
    near = -_highest(-depth)
    far = _highest(torch.where(depth.isfinite(), depth, -torch.inf))
    window = torch.stack((near - epsilon, far + epsilon), dim=-1)
    return torch.where(near.isfinite()[..., None], window, window.new_tensor((0.0, torch.inf)))


def landed(values: Tensor, index: Tensor, otherwise: float) -> Tensor:
    """`values` [N] at `index` [h, w], `otherwise` where that is -1."""
    return functional.pad(values, (0, 1), value=otherwise)[index.long()]  # -1 is the last one


def _highest(image: Tensor) -> Tensor:
    """Largest value of each pixel's 3 x 3 neighbourhood."""
    return functional.max_pool2d(image[None], 3, stride=1, padding=1)[0]


@torch.no_grad()
def render_guided(
    field: HashField,
    camera: Camera,
    occupancy: Occupancy,
    background: Tensor,
    probe: Probe,
    found: Evidence | None,
    *,
    stop: float = STOP,
    step: float = STEP,
    known: Tensor | None = None,
) -> FeatureFrame:
    """Render a frame, looking only where `found` says that something is; None: everywhere.

    Args:
        background: [K].
        stop: transmittance at which a ray ends.
        step: world length of a ray-marching step.
        known: [P] pixels that are not rendered, row by row.
    """
    march = partial(render_rays, field, occupancy=occupancy, probe=probe, step=step)
    device, size = field.table.device, camera.height * camera.width
    with probe.stage("rays"):
        seen, rays = rays_at_matter(camera, occupancy)
        if known is not None:
            left = torch.ones(size, dtype=torch.bool, device=device)
            left[known] = False
            left = left[seen]
            seen, rays = seen[left], rays.take(left)
        canvas = Pixels.blank(size, field.channels, device)
    probe.count("rays", len(seen), size)
    if found is None:
        rendered = march(rays, stop=stop)
    elif found.binding:
        window = found.window.view(-1, 2)[seen]
        rendered = march(rays, stop=stop, window=window)
    else:
        window, alpha = found.window.view(-1, 2)[seen], found.alpha.flatten()[seen]
        rendered = _march_within(march, rays, window, alpha, stop)
    with probe.stage("finish"):
        canvas.put(seen, rendered)
        return FeatureFrame.of(camera, canvas, background)


def _march_within(
    march: Callable[..., Pixels], rays: Rays, window: Tensor, alpha: Tensor, stop: float
) -> Pixels:
    """Render `rays` within `window` [R, 2] where that has an end and the ray reaches `alpha` [R]
    there; behind it, too, where the ray does not."""
    narrow = window[:, 1].isfinite()
    inside = narrow.nonzero().squeeze(1)
    expected = alpha[inside]
    loose = max(stop, 1 - KEPT_ALPHA)
    # Most of them end here, but those that go on are not to lack what is faint in front.
    first = march(rays.take(inside), stop=loose, window=window[inside], faint=FAINT * stop)
    enough = first.alpha >= KEPT_ALPHA * expected
    # What is left of the opacity looks like what was found.
    more = torch.where(enough & (first.alpha < expected), expected / first.alpha, 1)
    canvas = Pixels.blank(len(alpha), first.values.shape[1], alpha.device)
    canvas.put(
        inside, Pixels(first.values * more[:, None], first.depth_sum * more, first.alpha * more)
    )
    unfinished = torch.ones_like(narrow)
    unfinished[inside[enough]] = False
    rest = unfinished.nonzero().squeeze(1)
    begin = torch.where(narrow, window[:, 1], 0)[rest]
    behind = torch.stack((begin, torch.full_like(begin, torch.inf)), dim=1)
    canvas.put(rest, march(rays.take(rest), stop=stop, window=behind, carry=canvas.take(rest)))
    return canvas
