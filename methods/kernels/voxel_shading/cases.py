"""Cases of shaded voxels: colours and their gradients."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from bench.case import U32, Agreement, Case
from methods.kernels.dispatch import served
from methods.kernels.voxel_shading import shade_voxels

SUMS = 16 * 50 * 6 + 16 * 16 * 6
"""Error bound in u: sum of 16 products of harmonics (below 2, error 48 u) and numbers below 6."""


def cases() -> list[Case]:
    """No, one and many voxels; all degrees; forward and backward."""
    forward = Agreement(
        "shade_voxels",
        served(__package__),
        "the sum of `shade`, of which the sigmoid passes on a quarter, and 8 u of its own",
    )
    backward = Agreement(
        "shade_voxels backward",
        served(__package__),
        "harmonics below 2, off by 48 u, times slopes below 6 / 4, off by as much as colours are "
        "and 4 u, summed over at most 40 visits of a voxel",
    )
    found = []
    for count in (0, 1, 300, 1 << 16):
        for size in (1, 4, 9, 16) if count == 300 else (9,):
            name, items = f"{count:,} of {size} harmonics", count if count > 300 else None
            found += [
                forward.case(
                    name, partial(_shaded, count, size), (SUMS / 4 + 8) * U32, items=items
                ),
                backward.case(
                    name,
                    partial(_gradients, count, size),
                    40 * 6 * (2 * (SUMS / 4 + 12) + 48 + 40) * U32,
                    items=items,
                ),
            ]
    found.append(
        backward.case(
            "added to a buffer",
            partial(_gradients, 300, 9, buffered=True),
            40 * 6 * (2 * (SUMS / 4 + 12) + 48 + 40) * U32,
        )
    )
    return found


def _given(count: int, size: int, device: str) -> tuple[Tensor, ...]:
    """Harmonics, voxels, rays, directions and the gradient of the colours; all below 6."""
    generator = torch.Generator().manual_seed(count)
    voxels, rays = count // 3 + 1, count // 5 + 1
    harmonics = torch.randn(voxels, size, 3, generator=generator).clamp(-6, 6)
    voxel = torch.randint(voxels, (count,), generator=generator).int()
    ray = torch.randint(rays, (count,), generator=generator).sort().values.int()
    directions = normalize(torch.randn(rays, 3, generator=generator), dim=1)
    grad = torch.randn(count, 3, generator=generator).clamp(-6, 6)
    return tuple(x.to(device) for x in (harmonics, voxel, ray, directions, grad))


def _shaded(count: int, size: int, device: str) -> Callable[[str], tuple[Tensor, ...]]:
    *given, _ = _given(count, size, device)
    return lambda backend: (shade_voxels(*given, backend=backend),)


def _gradients(
    count: int, size: int, device: str, buffered: bool = False
) -> Callable[[str], tuple[Tensor, ...]]:
    harmonics, *given, grad = _given(count, size, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        learned = harmonics.detach().requires_grad_()
        buffer = torch.ones_like(harmonics) if buffered else None
        colours = shade_voxels(learned, *given, grad_buffer=buffer, backend=backend)
        colours.backward(grad)
        gradient = learned.grad if buffer is None else buffer - 1
        assert gradient is not None
        return (gradient,)

    return call
