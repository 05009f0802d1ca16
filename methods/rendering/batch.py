"""Volume rendering of a field along rays, all samples at once: to train."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from bench.cameras import cast, project
from bench.types import EMPTY_ALPHA, Camera, Rays
from methods.instant_ngp.field import HashField
from methods.kernels.composite import STOP, Pixels, composite, visible_counts
from methods.kernels.march import BRICK, Occupancy, march
from methods.rendering.occupancy import STEP

CHUNK_SAMPLES = 1 << 18
"""Samples whose density is evaluated together, without gradient: bounds the memory of a step."""

BATCH_QUANTUM = 1 << 11
"""Samples are handed to the field in multiples of this."""


def rays_at_matter(camera: Camera, occupancy: Occupancy) -> tuple[Tensor, Rays]:
    """The pixels that may see an occupied cell, as indices [P] row by row, and their rays.

    A pixel may see an occupied brick if it lies in the box around the projected corners of the
    brick; every pixel may, if one of them is not in front of the camera.
    """
    device = camera.c2w.device
    bricks = occupancy.words.nonzero().to(device)  # [B, 3]
    unit = torch.arange(2, device=device)
    corners = (bricks[:, None] + torch.cartesian_prod(unit, unit, unit)) * BRICK
    projected, depth = project(camera, corners.reshape(-1, 3) / occupancy.resolution)
    projected = projected.view(-1, 8, 2)
    behind = (depth.view(-1, 8) <= 0).any(dim=1)[:, None]  # [B, 1]

    size = torch.tensor((camera.width, camera.height), device=device)
    low = torch.where(behind, 0, projected.amin(dim=1)).floor().clamp(min=0)
    high = torch.where(behind, size, projected.amax(dim=1)).ceil().clamp(min=0)
    left, top = torch.minimum(low, size).long().unbind(dim=1)
    right, bottom = torch.minimum(high, size).long().unbind(dim=1)

    # How many boxes cover a pixel: the sum, over all pixels above and to the left, of +1 and -1 at
    # the boxes' corners.
    edges = torch.zeros(camera.height + 1, camera.width + 1, dtype=torch.int32, device=device)
    for row, column, sign in (
        (top, left, 1),
        (top, right, -1),
        (bottom, left, -1),
        (bottom, right, 1),
    ):
        edges.index_put_((row, column), torch.tensor(sign, dtype=torch.int32, device=device), True)
    covers = edges.cumsum(dim=0).cumsum(dim=1)[:-1, :-1]
    row, column = covers.nonzero().unbind(dim=1)
    return row * camera.width + column, cast(camera, torch.stack((column, row), dim=1) + 0.5)


def render_batch(
    field: HashField,
    rays: Rays,
    occupancy: Occupancy,
    jitter: Tensor | None,
    background: Tensor | None,
    *,
    stop: float = STOP,
    step: float = STEP,
) -> tuple[Pixels, int]:
    """Render `rays` differentiably; also the number of samples that took part.

    Samples behind the early stop, more than half of all once surfaces have formed, have neither
    weight nor gradient: the density of all samples, without gradient, tells which they are.

    Args:
        jitter: [R] phase of the samples of each ray, in [0, 1); None: as `rounds.render_rays`.
        background: [K] or [R, K]; None: not composited on any.
        stop: transmittance at which a ray ends.
        step: world length of a ray-marching step.
    """
    samples = march(rays, occupancy, step, jitter=jitter, backend=field.backend)
    with torch.no_grad():
        parts = pad(samples.positions).split(CHUNK_SAMPLES)
        sigma = torch.cat([field.density(part)[0] for part in parts])[: len(samples)]
        counts = visible_counts(sigma, samples, stop=stop, backend=field.backend)
    samples = samples.front(counts)
    sigma, values = query(
        field, samples.positions, samples.ray, field.encode_directions(rays.directions)
    )
    pixels = composite(sigma, values, samples, stop=stop, backend=field.backend)
    return pixels if background is None else pixels.over(background), len(samples)


def opacity_entropy(opacity: Tensor) -> Tensor:
    """Mean of -o ln o of `opacity` [R]: least where every ray meets all or nothing."""
    opacity = opacity.clamp(1e-5, 1 - 1e-5)
    return -(opacity * opacity.log()).mean()


def query(
    field: HashField, positions: Tensor, ray: Tensor, encoded: Tensor
) -> tuple[Tensor, Tensor]:
    """Density [S] and features [S, K] at `positions` [S, 3] on rays `ray` [S] whose directions are
    `encoded` [R, 16].

    The field sees padded batches.
    """
    sigma, geometry = field.density(pad(positions))
    values = field.features(geometry, encoded[pad(ray)])
    return sigma[: len(positions)], values[: len(positions)]


def pad(samples: Tensor) -> Tensor:
    """Zeros at the end of [S, ...], up to a multiple of `BATCH_QUANTUM`.

    A field is to see batches of a few round sizes only: the library behind the matrix products
    prepares code for every new size, which takes longer than the product itself.
    """
    padding = -len(samples) % BATCH_QUANTUM
    return functional.pad(samples, (0, 0) * (samples.dim() - 1) + (0, padding))


@dataclass(frozen=True)
class FeatureFrame:
    """What a field shows to a camera (SteerNeRF Eq. 3 to 5).

    Attributes:
        camera: of `width` x `height` pixels, w x h below.
        values: [h, w, K] features on the background, the first three are RGB.
        depth: [h, w] z-depth, +inf where nothing is.
        alpha: [h, w] opacity.
    """

    camera: Camera
    values: Tensor
    depth: Tensor
    alpha: Tensor

    @classmethod
    def of(cls, camera: Camera, pixels: Pixels, background: Tensor) -> FeatureFrame:
        """From all pixels of `camera`, not yet composited on `background` [K]."""
        values = pixels.values + (1 - pixels.alpha)[:, None] * background
        seen = pixels.alpha > EMPTY_ALPHA
        depth = torch.where(seen, pixels.depth_sum / pixels.alpha, torch.inf)
        shape = (camera.height, camera.width)
        return cls(camera, values.view(*shape, -1), depth.view(shape), pixels.alpha.view(shape))
