"""Harmonics with Triton: a program evaluates a block of directions."""

import triton
import triton.language as tl
from torch import Tensor

from methods.kernels import spherical
from methods.kernels.gpu import check_float32, launch, vector

BLOCK = tl.constexpr(256)  # directions

C00, C1, C2, C20, C22 = map(tl.constexpr, spherical.FACTORS[:5])
C33, C3XYZ, C31, C30, C32 = map(tl.constexpr, spherical.FACTORS[5:])


def harmonics(directions: Tensor) -> Tensor:
    check_float32(directions=directions)
    if directions.requires_grad:
        raise ValueError("backend 'gpu' gives no gradient for directions: use backend='reference'")
    values = directions.new_empty(len(directions), spherical.CHANNELS)
    programs = triton.cdiv(len(directions), BLOCK.value)
    launch(_evaluate, (programs,), directions.contiguous(), values, len(directions))
    return values


def shade(coefficients: Tensor, directions: Tensor) -> Tensor:
    basis = harmonics(directions)[:, : coefficients.shape[1]]
    return (basis[:, :, None] * coefficients).sum(dim=1)


@triton.jit
def _evaluate(directions, out, total):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < total
    x, y, z = vector(directions, i, inside)
    xx, yy, zz = x * x, y * y, z * z
    out += 16 * i
    tl.store(out, C00, mask=inside)
    tl.store(out + 1, y * C1, mask=inside)
    tl.store(out + 2, z * C1, mask=inside)
    tl.store(out + 3, x * C1, mask=inside)
    tl.store(out + 4, x * y * C2, mask=inside)
    tl.store(out + 5, y * z * C2, mask=inside)
    tl.store(out + 6, (2 * zz - xx - yy) * C20, mask=inside)
    tl.store(out + 7, x * z * C2, mask=inside)
    tl.store(out + 8, (xx - yy) * C22, mask=inside)
    tl.store(out + 9, y * (3 * xx - yy) * C33, mask=inside)
    tl.store(out + 10, x * y * z * C3XYZ, mask=inside)
    tl.store(out + 11, y * (4 * zz - xx - yy) * C31, mask=inside)
    tl.store(out + 12, z * (2 * zz - 3 * xx - 3 * yy) * C30, mask=inside)
    tl.store(out + 13, x * (4 * zz - xx - yy) * C31, mask=inside)
    tl.store(out + 14, z * (xx - yy) * C32, mask=inside)
    tl.store(out + 15, x * (xx - 3 * yy) * C33, mask=inside)
