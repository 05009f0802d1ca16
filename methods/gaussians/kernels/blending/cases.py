"""Cases of the blending of Gaussians: agreement of the backends, and results known in advance."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Tensor

from bench.cameras import pixel_grid
from bench.case import DTYPES, U32, Agreement, Case, Property, on_backends
from methods.gaussians.kernels.blending import LARGEST_ALPHA, blend
from methods.gaussians.kernels.projection import LEAST_ALPHA, Ellipses
from methods.kernels.composite import STOP
from methods.kernels.dispatch import served
from methods.kernels.types import Pixels

CLEAR = 1e-4
"""Minimum relative distance of every opacity, at every pixel, from a threshold of a comparison."""

SIZES = (
    ("one pixel", 30, 1, 1, 1),
    ("no Gaussian", 0, 20, 10, 1),
    ("one tile", 60, 16, 16, 1),
    ("parts of tiles", 200, 67, 45, 1),
    ("of many tiles", 10, 67, 45, 10),
    ("crowded", 600, 21, 19, 1),
    ("160 x 160", 2000, 160, 160, 1),
)
"""Number of Gaussians, width and height of the picture, factor on the size of the Gaussians."""

Given = tuple[Ellipses, Tensor, Tensor]
"""Ellipses, opacities, colours."""


def cases() -> list[Case]:
    """No, some and crowded Gaussians; one alone; two in one place; a plain loop; order; stop."""
    backends = served(__package__)
    forward = Agreement(
        "gaussian blending",
        backends,
        "weights of at most 1 in all, each a product of as many factors as Gaussians are in front, "
        "with 20 roundings; what is behind the stop adds less than it: 600 x 20 u and the stop",
    )
    backward = Agreement(
        "gaussian blending backward",
        backends,
        "relative to the largest gradient of its kind; its terms, together at most some ten times "
        "as large, are off as the weights are: 10 x 600 x 20 u",
    )
    found = []
    for name, count, width, height, size in SIZES:
        items = count if count == 2000 else None
        inputs = count, width, height, size
        found += [
            forward.case(name, partial(_blended, *inputs), 12_000 * U32 + STOP, items=items),
            backward.case(name, partial(_gradients, *inputs), 120_000 * U32, items=items),
        ]
    known = Property(
        "gaussian blending",
        "the picture is that of a loop over pixels and Gaussians",
        "as in the agreement of the backends, of 60: 1,200 u",
        on_backends(1200, "fp64", backends=backends),
    )
    footprint = Property(
        "gaussian blending",
        "a Gaussian alone is its own formula",
        "20 roundings of numbers below 4",
        on_backends(80, "fp64", backends=backends),
    )
    two = Property(
        "gaussian blending",
        "the nearer of two in one place is in front, whichever is given first",
        "10 roundings",
        on_backends(10, "fp64", backends=backends),
    )
    hidden = Property(
        "gaussian blending",
        "what is behind the stop has no gradient",
        "nothing is computed: 0",
        on_backends(0, "fp64", backends=backends),
    )
    found.append(known.case("13 x 9", _loop_error))
    for opacity in (1.0, 0.5, 2 * LEAST_ALPHA):
        found.append(footprint.case(f"opacity {opacity:.3g}", partial(_footprint_error, opacity)))
    for flipped in (False, True):
        name = "the farther first" if flipped else "the nearer first"
        found.append(two.case(name, partial(_two_error, flipped)))
    found.append(hidden.case("a wall", _hidden_gradient))
    return found


@cache
def draw(count: int, width: int, height: int, size: int = 1) -> Given:
    """Gaussians in and around a picture, one to six pixels wide, or `size` times as wide.

    Gaussians whose opacity at some pixel is close to a cut-off are left out, because there rounding
    would decide.
    """
    generator = torch.Generator().manual_seed(count + width)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    centres = (rand(count, 2) * 1.4 - 0.2) * torch.tensor((width, height))
    variances = size**2 * (0.3 + 4 * rand(count, 2))
    tilt = (1.6 * rand(count) - 0.8) * variances.prod(dim=1).sqrt()
    area = variances.prod(dim=1) - tilt**2
    conics = torch.stack((variances[:, 1], -tilt, variances[:, 0]), dim=1) / area[:, None]
    opacities = 0.9 * rand(count)
    reach = 2 * (opacities / LEAST_ALPHA).clamp(min=1).log()
    extents = (reach[:, None] * variances).sqrt()
    ellipses = Ellipses(centres, conics, 1 + rand(count), extents)
    near = torch.zeros(count, dtype=torch.bool)
    for part in torch.arange(count).split(100):
        alpha = _alphas(_take(ellipses, part), opacities[part], width, height)
        near[part] = ((alpha / LEAST_ALPHA - 1).abs() < CLEAR).any(dim=0)
    keep = (~near).nonzero().squeeze(1)
    return _take(ellipses, keep), opacities[keep], rand(len(keep), 3)


def _take(ellipses: Ellipses, index: Tensor) -> Ellipses:
    return Ellipses(
        ellipses.centres[index],
        ellipses.conics[index],
        ellipses.depth[index],
        ellipses.extents[index],
    )


def _to(given: Given, device: str, dtype: torch.dtype) -> Given:
    ellipses, opacities, colours = given
    parts = (ellipses.centres, ellipses.conics, ellipses.depth, ellipses.extents)
    moved = Ellipses(*(x.to(device, dtype) for x in parts))
    return moved, opacities.to(device, dtype), colours.to(device, dtype)


def _alphas(ellipses: Ellipses, opacities: Tensor, width: int, height: int) -> Tensor:
    """Opacity [P, N] of each Gaussian at each pixel, in float64, without cut-offs."""
    offset = pixel_grid(width, height).double()[:, None] - ellipses.centres.double()
    a, b, c = ellipses.conics.double().unbind(dim=1)
    x, y = offset.unbind(dim=2)
    return opacities.double() * (-(a * x * x + 2 * b * x * y + c * y * y) / 2).exp()


def _blended(
    count: int, width: int, height: int, size: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    given = _to(draw(count, width, height, size), device, torch.float32)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels = blend(*given, width, height, backend=backend)
        return pixels.values, pixels.depth_sum / 2, pixels.alpha  # depths are below 2

    return call


def _gradients(
    count: int, width: int, height: int, size: int, device: str
) -> Callable[[str], tuple[Tensor, ...]]:
    drawn = draw(count, width, height, size)
    ellipses, opacities, colours = _to(drawn, device, torch.float32)
    generator = torch.Generator().manual_seed(2)
    towards = (
        torch.randn(width * height, 3, generator=generator).to(device),
        torch.randn(width * height, generator=generator).to(device),
    )

    def call(backend: str) -> tuple[Tensor, ...]:
        given = [
            x.clone().requires_grad_()
            for x in (ellipses.centres, ellipses.conics, opacities, colours)
        ]
        moved = Ellipses(given[0], given[1], ellipses.depth, ellipses.extents)
        pixels = blend(moved, given[2], given[3], width, height, stop=0.0, backend=backend)
        grads = torch.autograd.grad((pixels.values, pixels.alpha), given, towards)
        largest = [grad.abs().max().clamp(min=1e-30) if len(grad) else 1.0 for grad in grads]
        return tuple(grad / size for grad, size in zip(grads, largest, strict=True))

    return call


def _loop_error(backend: str, device: str, precision: str) -> float:
    width, height = 13, 9
    given = _to(draw(60, width, height), device, DTYPES[precision])
    got = blend(*given, width, height, stop=0.0, backend=backend)
    ellipses, opacities, colours = _to(draw(60, width, height), "cpu", torch.float64)
    alphas = _alphas(ellipses, opacities, width, height)
    worst = 0.0
    for pixel in range(width * height):
        light, total = 1.0, [0.0] * 5  # r, g, b, depth, alpha
        for i in ellipses.depth.argsort().tolist():
            alpha = min(alphas[pixel, i].item(), LARGEST_ALPHA)
            if alpha < LEAST_ALPHA:
                continue
            shown = (*colours[i].tolist(), ellipses.depth[i].item(), 1.0)
            total = [t + light * alpha * value for t, value in zip(total, shown, strict=True)]
            light *= 1 - alpha
        found = *got.values[pixel].tolist(), got.depth_sum[pixel].item(), got.alpha[pixel].item()
        worst = max(worst, *(abs(f - t) for f, t in zip(found, total, strict=True)))
    return worst


def _alone(opacity: float, device: str, dtype: torch.dtype) -> Given:
    """One Gaussian near the middle of a picture of 33 x 29 pixels."""
    variance, tilt = 9.0, 3.0
    area = variance * variance - tilt * tilt
    ellipses = Ellipses(
        torch.tensor([[16.3, 14.1]]),
        torch.tensor([[variance, -tilt, variance]]) / area,
        torch.tensor([2.0]),
        torch.full((1, 2), math.sqrt(2 * math.log(max(opacity / LEAST_ALPHA, 1)) * variance)),
    )
    given = ellipses, torch.tensor([opacity]), torch.tensor([[1.0, 0.5, 0.25]])
    return _to(given, device, dtype)


def _footprint_error(opacity: float, backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    got = blend(*_alone(opacity, device, dtype), 33, 29, backend=backend)
    ellipses, opacities, colours = _alone(opacity, "cpu", dtype)
    alpha = _alphas(ellipses, opacities, 33, 29)[:, 0].clamp(max=LARGEST_ALPHA)
    clear = (alpha / LEAST_ALPHA - 1).abs() > CLEAR
    alpha = torch.where(alpha >= LEAST_ALPHA, alpha, 0)
    want = Pixels(alpha[:, None] * colours.double(), 2 * alpha, alpha)
    errors = (
        (got.values.double().cpu() - want.values).abs().amax(dim=1),
        (got.depth_sum.double().cpu() - want.depth_sum).abs(),
        (got.alpha.double().cpu() - want.alpha).abs(),
    )
    return max(error[clear].max().item() for error in errors)


def _two_error(flipped: bool, backend: str, device: str, precision: str) -> float:
    dtype = DTYPES[precision]
    one, opacity, _ = _alone(0.5, device, dtype)
    depth = torch.tensor([1.0, 2.0]).to(device, dtype)
    colours = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]).to(device, dtype)
    if flipped:
        depth, colours = depth.flip(0), colours.flip(0)
    both = Ellipses(
        one.centres.repeat(2, 1), one.conics.repeat(2, 1), depth, one.extents.repeat(2, 1)
    )
    got = blend(both, opacity.repeat(2), colours, 33, 29, backend=backend)
    alone = blend(one, opacity, colours[:1], 33, 29, backend=backend).alpha
    near, far = got.values[:, 0] - alone, got.values[:, 1] - alone * (1 - alone)
    return max(near.abs().max().item(), far.abs().max().item())


def _hidden_gradient(backend: str, device: str, precision: str) -> float:
    """Gradient of a Gaussian behind three opaque ones, which let through 1e-6 < STOP."""
    dtype = DTYPES[precision]
    one, _, _ = _alone(1.0, device, dtype)
    wide = torch.full((4, 2), 40.0).to(device, dtype)
    flat = torch.tensor([1e-6, 0.0, 1e-6]).to(device, dtype).repeat(4, 1)
    depth = torch.arange(1.0, 5.0).to(device, dtype)
    wall = Ellipses(one.centres.repeat(4, 1), flat, depth, wide)
    colours = torch.ones(4, 3).to(device, dtype).requires_grad_()
    opacities = torch.full((4,), 0.99).to(device, dtype).requires_grad_()
    blend(wall, opacities, colours, 33, 29, backend=backend).values.sum().backward()
    assert colours.grad is not None
    assert opacities.grad is not None
    return max(colours.grad[3].abs().max().item(), abs(opacities.grad[3].item()))
