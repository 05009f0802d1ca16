"""Ray marching in plain torch: test every step of every ray, keep those in occupied cells."""

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import ThreeTensors, TwoTensors
from methods.kernels.march import LEAST_STEP, Segments, longest_ray
from methods.kernels.march.contraction import Course, contract
from methods.kernels.types import (
    PARALLEL,
    Occupancy,
    Samples,
    joined,
    offsets_of,
    total_and_longest,
)

BLOCK = 1 << 12  # rays that are tested at a time: [BLOCK, 1024, 3] positions are 50 MB


def march(segments: Segments, occupancy: Occupancy) -> Samples:
    steps = _Steps(segments, occupancy)
    kept, counts, resume = joined(steps.taken(occupancy))
    offsets = offsets_of(counts)
    total, longest = total_and_longest(counts, offsets)
    place = torch.nonzero_static(kept.flatten(), size=total).squeeze(1)
    ray = place // max(steps.most, 1)
    k = place % max(steps.most, 1)
    t, positions = steps.at(ray, k)
    course = steps.course
    delta = torch.full_like(t, segments.step) if course is None else course.lengths(ray, t)
    where = t, delta, offsets, ray.int(), positions, resume
    return Samples(*where, longest=longest)


class _Steps:
    """The steps of R rays, at most `most` for each; see `clip`."""

    def __init__(self, segments: Segments, occupancy: Occupancy) -> None:
        self.segments, self.most = segments, longest_ray(segments.step)
        self.course = course_of(segments, occupancy)
        self.near, self.far, self.length, self.alive = clip(segments, self.course)
        # A GPU would make the host wait.
        if self.alive.device.type == "cpu" and self.course is None:
            count = torch.where(self.alive, (self.far - self.near) / self.length, 0).ceil()
            self.most = int(functional.pad(count, (0, 1)).max().clamp(max=self.most))

    def at(self, ray: Tensor, k: Tensor) -> TwoTensors:
        """t [...] and positions [..., 3] of the steps `k` of the rays `ray`."""
        rays, phased = self.segments.rays, k + self.segments.jitter[ray]
        if self.course is None:
            t = self.near[ray] + phased * self.length[ray]
            return t, rays.origins[ray] + t[..., None] * rays.directions[ray]
        t = self.course.at(ray, phased)
        return t, contract(rays.origins[ray] + t[..., None] * rays.directions[ray])

    def taken(self, occupancy: Occupancy) -> Iterator[ThreeTensors]:
        """For each batch of rays: which steps are samples [R, most], counts [R], resume [R]."""
        rays = torch.arange(len(self.near), device=self.near.device)[:, None]
        k, limit = torch.arange(self.most, device=self.near.device), self.segments.limit
        for ray in rays.split(BLOCK):
            t, positions = self.at(ray, k)  # [R, K], [R, K, 3]
            candidate = self.alive[ray] & (t >= self.segments.window[ray, 0]) & (t < self.far[ray])
            candidate &= k >= self.segments.start[ray]
            candidate &= occupancy.holds(torch.where(candidate[..., None], positions, 0))
            kept = candidate & (candidate.cumsum(dim=1) <= limit)
            counts = kept.sum(dim=1)
            last = (kept * (k + 1)).amax(dim=1) if len(k) else counts
            yield kept, counts, torch.where(counts == limit, last, -1).int()


def course_of(segments: Segments, occupancy: Occupancy) -> Course | None:
    """The steps of rays in contracted space; None if space is not."""
    return Course.of(segments.rays, segments.step) if occupancy.contracted else None


def clip(segments: Segments, course: Course | None) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The range of t inside the cube, as far as the window reaches, the step in t (at v = 0 of a
    `course`), and whether to march: near, far, step and mask, [R] each."""
    origins, directions = segments.rays.origins, segments.rays.directions
    if course is None:
        slope, parallel = slopes(directions)
        entry, leave = crossed(origins, parallel, -origins * slope, (1 - origins) * slope)
        near = entry.clamp(min=0)
    else:
        near, leave = torch.zeros_like(course.end), course.end
    far = torch.minimum(leave, segments.window[:, 1])
    length = lengths(directions)
    # A true division: `step / length` would multiply by the reciprocal, which is an ulp off.
    step_t = torch.full_like(length, segments.step) / length
    alive = (near < far) & far.isfinite() & (segments.start >= 0)
    return near, far, step_t, alive & step_t.isfinite() & (step_t >= LEAST_STEP)


def lengths(directions: Tensor) -> Tensor:
    """Lengths [R] of directions [R, 3]; in float64, so all backends round to the same float32."""
    return directions.double().norm(dim=-1).to(directions.dtype)


def slopes(directions: Tensor) -> TwoTensors:
    """Change of t per length along each axis [R, 3], 0 for a ray that does not move along it, and
    whether it does not."""
    parallel = directions.abs() < PARALLEL
    return torch.where(parallel, 0, 1 / torch.where(parallel, 1, directions)), parallel


def crossed(origins: Tensor, parallel: Tensor, first: Tensor, second: Tensor) -> TwoTensors:
    """Where rays enter and leave [0, 1]^3, given the t [R, 3] at which they cross its two planes of
    each axis; enter > leave if they miss it (slab test)."""
    outside = torch.where((origins >= 0) & (origins <= 1), -torch.inf, torch.inf)
    lower = torch.where(parallel, outside, torch.minimum(first, second))
    upper = torch.where(parallel, -outside, torch.maximum(first, second))
    return lower.amax(dim=-1), upper.amin(dim=-1)
