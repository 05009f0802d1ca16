"""Volume rendering of frames: features, depth and opacity of the pixels of a camera."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from bench.cameras import cast, project
from bench.types import EMPTY_ALPHA, Camera, Frame, Probe, Rays, TwoTensors
from methods.kernels.composite import composite, visibility
from methods.kernels.march import march
from methods.kernels.types import BRICK, Occupancy, Pixels, Samples, joined
from methods.rendering.compaction import compacts
from methods.rendering.field import CACHED_SAMPLES, CHUNK_SAMPLES, Field, pad, query
from methods.rendering.sampling import Sampling

CHUNK_RAYS = 1 << 16
"""Rays rendered together on a CPU: enough for all threads, few enough to stay in the cache."""

GPU_RAYS = 1 << 20
"""Rays rendered together on a GPU: few chunks, because the host waits for each round of each."""

GPU_SAMPLES = 1
"""Samples of a ray in the first round on a GPU. `totem` at 800x800 (`budget=quick`) evaluates 1.33
samples for each visible one in 6 rounds; from 2 on 1.47, from 4 1.52."""

Render = Callable[[Tensor, Rays], Pixels]
"""Renders some pixels of a frame, given their row-major indices [P] and their rays."""

Renderer = tuple[Occupancy, Render]
"""The cells that may show anything, and what renders the pixels that may see them."""


@dataclass(frozen=True)
class FeatureFrame:
    """A field as a camera of w x h pixels sees it: F and D of SteerNeRF."""

    camera: Camera
    values: Tensor  # [h, w, K] features on the background; the first three are RGB
    depth: Tensor  # [h, w] z-depth, +inf where a pixel is empty
    alpha: Tensor  # [h, w] opacity

    @classmethod
    def of(cls, camera: Camera, pixels: Pixels, background: Tensor) -> Self:
        """Make a frame of all pixels of `camera`, and composite them on `background` [K]."""
        values = pixels.over(background).values
        seen = pixels.alpha > EMPTY_ALPHA
        depth = torch.where(seen, pixels.depth_sum / pixels.alpha, torch.inf)
        shape = (camera.height, camera.width)
        return cls(camera, values.view(*shape, -1), depth.view(shape), pixels.alpha.view(shape))

    def picture(self) -> Frame:
        """The picture of a field that has no features beyond RGB."""
        return Frame(self.values, self.depth, self.alpha)


@torch.no_grad()
def render_frame(
    camera: Camera, occupancy: Occupancy, background: Tensor, probe: Probe, render: Render
) -> FeatureFrame:
    """Render the frame of `camera`, composited on `background` [K]; `render` renders the pixels
    that may see matter."""
    size = camera.height * camera.width
    with probe.stage("rays"):
        seen, rays = rays_at_matter(camera, occupancy)
        canvas = Pixels.blank(size, len(background), background.device)
    probe.count("rays", len(seen), size)
    rendered = render(seen, rays)
    with probe.stage("finish"):
        canvas.put(seen, rendered)
        return FeatureFrame.of(camera, canvas, background)


def everywhere(field: Field, occupancy: Occupancy, probe: Probe, how: Sampling) -> Render:
    """Make the argument `render` of `render_frame` that marches whole rays, or marches them within
    `how.window` [h * w, 2], which is given for all pixels."""

    def render(seen: Tensor, rays: Rays) -> Pixels:
        return render_rays(field, rays, occupancy, probe, how.of(seen))

    return render


def rays_at_matter(camera: Camera, occupancy: Occupancy) -> tuple[Tensor, Rays]:
    """The pixels that may see an occupied cell, as row-major indices [P], and their rays. The host
    waits for a GPU once."""
    row, column = sees_matter(camera, occupancy).nonzero().unbind(dim=1)
    return row * camera.width + column, cast(camera, torch.stack((column, row), dim=1) + 0.5)


def sees_matter(camera: Camera, occupancy: Occupancy) -> Tensor:
    """Which pixels may see an occupied cell: [h, w] bool. A pixel may see an occupied brick if it
    lies in the bounding box of the brick's projected corners; if one of the corners is not in front
    of the camera, every pixel may. In contracted space every pixel may."""
    device = camera.c2w.device
    if occupancy.contracted:
        return torch.ones(camera.height, camera.width, dtype=torch.bool, device=device)
    bricks = occupancy.bricks.to(device)
    unit = torch.arange(2, device=device)
    corners = (bricks[:, None] + torch.cartesian_prod(unit, unit, unit)) * BRICK
    projected, depth = project(camera, corners / occupancy.resolution)  # [B, 8, 2], [B, 8]
    behind = (depth <= 0).any(dim=1)[:, None]  # [B, 1]

    low = torch.where(behind, 0, projected.amin(dim=1)).floor()
    high = torch.where(behind, torch.inf, projected.amax(dim=1)).ceil()
    (left, top), (right, bottom) = (
        [x.clamp(0, size).long() for x, size in zip(ends.unbind(dim=1), camera.size, strict=True)]
        for ends in (low, high)
    )

    # How many boxes cover a pixel: the 2D prefix sum, from the top left, of +1 and -1 at
    # the corners of the boxes.
    edges = torch.zeros(camera.height + 1, camera.width + 1, dtype=torch.int32, device=device)
    corner_signs = ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1))
    for row, column, sign in corner_signs:
        edges.index_put_((row, column), edges.new_full((), sign), True)
    return edges.cumsum(dim=0).cumsum(dim=1)[:-1, :-1] != 0


@torch.no_grad()
def render_rays(
    field: Field, rays: Rays, occupancy: Occupancy, probe: Probe, how: Sampling
) -> Pixels:
    """Render R `rays`. Values are not composited on a background.

    Rays are rendered in rounds, so that few samples are evaluated behind the early stop: a round
    takes the next few samples of the rays that are still open, evaluates and composites them, and
    closes the rays that have ended. The fewer rays are left, the more samples each takes.

    On a CPU closed rays are dropped. On a GPU they stay, without samples, so that the host waits
    once a round, for the number of samples. Rounds begin with a single sample of each ray and at
    least double.
    """
    size = CHUNK_RAYS if compacts(rays.origins.device) else GPU_RAYS
    parts = []
    for first in range(0, max(len(rays.origins), 1), size):
        chunk = slice(first, first + size)
        # Contiguous, as kernels want them; once.
        some = Rays(rays.origins[chunk].contiguous(), rays.directions[chunk])
        parts.append(_render_chunk(field, some, occupancy, probe, how.of(chunk)).columns)
    return Pixels(*joined(parts))


def _render_chunk(
    field: Field, rays: Rays, occupancy: Occupancy, probe: Probe, how: Sampling
) -> Pixels:
    """`render_rays` for rays that are rendered together."""
    count = len(rays.origins)
    device = rays.origins.device
    with probe.stage("field"):
        directions = field.encode_directions(rays.directions)
    canvas = Pixels.blank(count, field.channels, device)

    def advance(
        index: Tensor | slice, front: Pixels, start: Tensor, limit: int
    ) -> tuple[int, Pixels, Tensor, Tensor]:
        """Composite the next samples of some rays behind `front`; return how many there were, the
        pixels, where the rays resume, and which of them still see something."""
        with probe.stage("march"):
            samples = march(
                rays.take(index),
                occupancy,
                how.step,
                window=how.of(index).window,
                start=start,
                limit=limit,
                backend=field.backend,
            )
        probe.count("samples", len(samples))
        if len(samples):
            sigma, values = _evaluated(field, samples, directions[index], front, how, probe)
            with probe.stage("composite"):
                front = composite(
                    sigma, values, samples, stop=how.stop, carry=front, backend=field.backend
                )
        return len(samples), front, samples.resume, 1 - front.alpha > how.stop

    start = torch.zeros(count, dtype=torch.int32, device=device)
    if compacts(device):
        left = torch.arange(count)
        while len(left):
            limit = field.round_samples * max(count // (2 * len(left)), 1)
            _, front, resume, sees = advance(left, canvas.take(left), start, limit)
            with probe.stage("composite"):
                canvas.put(left, front)
                going = (sees & (resume >= 0)).nonzero().squeeze(1)
                left = left[going]
                start = resume[going]
        return canvas
    limit = taken = most = GPU_SAMPLES
    while taken >= limit:  # else no ray resumes: each would have taken as many as it may
        taken, canvas, resume, sees = advance(slice(None), canvas, start, limit)
        start = torch.where(sees, resume, -1)
        most = max(most, taken)
        limit *= max(most // (2 * taken), 2) if taken else 1
    return canvas


def _evaluated(
    field: Field, samples: Samples, encoded: Tensor, front: Pixels, how: Sampling, probe: Probe
) -> TwoTensors:
    """Density [S] and features [S, K] of `samples` behind the pixels in `front`; features of faint
    samples are 0. `encoded` [R, D] are the directions of the rays."""

    def bright(sigma: Tensor) -> Tensor:
        through = 1 - front.alpha
        seen = visibility(sigma, samples, stop=how.stop, front=through, backend=field.backend)
        return seen.weights > how.least_weight

    with probe.stage("field"):
        if compacts(samples.t.device):
            sigma, geometry = field.density(pad(samples.positions))
            sigma = sigma[: len(samples)]
            seen = bright(sigma).nonzero().squeeze(1)
            shaded = len(seen)
            values = sigma.new_zeros(len(samples), field.channels)
            for part in seen.split(CACHED_SAMPLES):
                index = pad(part)
                view = encoded.index_select(0, samples.ray.index_select(0, index))
                shown = field.features(geometry.index_select(0, index), view)
                values.index_copy_(0, part, shown[: len(part)])
        else:
            columns = samples.positions.split(CHUNK_SAMPLES), samples.ray.split(CHUNK_SAMPLES)
            parts = [query(field, *piece, encoded) for piece in zip(*columns, strict=True)]
            sigma, values = joined(parts)
            shaded = len(samples)
            values = torch.where(bright(sigma)[:, None], values, 0)
    probe.count("shaded_samples", shaded, len(samples))
    field.count(probe, len(samples), shaded)
    return sigma, values
