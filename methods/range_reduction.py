"""Range reduction: where a preceding depth says that a ray should look (SteerNeRF Eq. 6 to 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, pixel_grid
from bench.types import Camera, Probe
from methods.buffer import Cloud, Reprojection
from methods.fields import HashField
from methods.kernels.composite import STOP
from methods.kernels.march import Occupancy
from methods.volume import FeatureFrame, render_pixels, render_rays

KEPT_ALPHA = 0.95
"""A ray whose window leaves less than this share of the opacity it had is marched in full."""


@dataclass(frozen=True)
class RangeReduction:
    """Where along a ray to look for a surface, given the newest preceding frame.

    Attributes:
        mode: "off": everywhere. "paper": within `epsilon` of the depth reprojected onto the pixel
            (Eq. 8). "window": within `epsilon` of the depths reprojected onto its 3 x 3
            neighbourhood; in full at depth edges, and again in full where the window turns out to
            have missed what was there.
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
    """

    window: Tensor
    alpha: Tensor

    def missed(self, alpha: Tensor) -> Tensor:
        """Where `alpha` [h w], found inside a narrowed window, is less than was to be expected."""
        narrowed = self.window[..., 1].isfinite()
        return (narrowed & (alpha.view_as(self.alpha) < KEPT_ALPHA * self.alpha)).flatten()


def evidence(
    cloud: Cloud, camera: Camera, options: RangeReduction, reprojection: Reprojection, backend: str
) -> Evidence:
    """What `cloud` tells of the depths that `camera`, a low-resolution one, will see."""
    index, depth = cloud.land(camera, reprojection, backend)
    known = index >= 0
    near = _at(depth, index, torch.inf)
    far = _at(depth, index, -torch.inf)
    if options.mode == "window":
        near, far = -_highest(-near), _highest(far)
        known = near.isfinite() & (far - near < 2 * options.epsilon)  # else a depth edge
    window = torch.stack(
        (
            torch.where(known, near - options.epsilon, 0),
            torch.where(known, far + options.epsilon, torch.inf),
        ),
        dim=-1,
    )
    return Evidence(window, _at(cloud.alpha, index, 0.0))


def _at(values: Tensor, index: Tensor, otherwise: float) -> Tensor:
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
    repair: bool = True,
    stop: float = STOP,
) -> FeatureFrame:
    """Render a frame, looking only where a preceding one says that something is.

    Args:
        found: what the preceding frame says; None: look everywhere.
        repair: march rays in full where the window turns out to have missed what was there.
    """
    window = None if found is None else found.window
    canvas = render_pixels(field, camera, occupancy, probe, stop=stop, window=window)
    if found is not None and repair:
        missed = found.missed(canvas.alpha).nonzero().squeeze(1)
        probe.count("repaired", len(missed), len(canvas.alpha))
        centres = pixel_grid(camera.width, camera.height, missed.device)[missed]
        canvas.put(missed, render_rays(field, cast(camera, centres), occupancy, probe, stop=stop))
    return FeatureFrame.of(camera, canvas, background)
