"""Multi-resolution hash-grid encoding of positions (Müller et al. 2022, Section 3).

Level l has scale_l = N_min b^l - 1 and res_l = ceil(scale_l) + 1 vertices along an axis; a position
x in [0, 1]^3 lies at p = scale_l x + 1/2, its cell is floor(p), its trilinear weights frac(p)
(the conventions of tiny-cuda-nn, `common_device.h` and `grid.h`). A level whose res^3 vertices fit
into 2^log2_table entries is dense, x + y res + z res^2; the others are hashed,
(x ^ y * 2654435761 ^ z * 805459861) mod 2^log2_table in 32-bit arithmetic. Because of the half-cell
offset, a cell at the far side of a dense level has vertices beyond the res^3; indices wrap around.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import torch
from torch import Tensor

from bench.types import TwoTensors, check_shape
from methods.kernels.dispatch import implementation
from methods.kernels.types import expect

PRIMES = (1, 2654435761, 805459861)


@dataclass(frozen=True)
class HashGrid:
    """The shape of a hash-grid table: how many `levels` of 2^`log2_table` entries at most, each of
    F `features`; vertices along an axis at the coarsest level, `n_min`, and at the finest, `n_max`.
    """

    levels: int
    features: int
    log2_table: int
    n_min: int
    n_max: int

    def __post_init__(self) -> None:
        whole = self.levels >= 1 and self.features >= 1 and 3 <= self.log2_table <= 24
        expect(whole, "grid", "levels, features >= 1 and log2_table in 3..24", self)
        expect(2 <= self.n_min <= self.n_max, "grid", "2 <= n_min <= n_max", self)

    @cached_property
    def scales(self) -> tuple[float, ...]:
        """Grid cells along a side of the unit cube, for each level."""
        growth = math.log(self.n_max / self.n_min) / max(self.levels - 1, 1)
        return tuple(self.n_min * math.exp(level * growth) - 1 for level in range(self.levels))

    @cached_property
    def resolutions(self) -> tuple[int, ...]:
        """Vertices along an axis, for each level."""
        # Rounded first, because n_max comes out of log and exp and could become n_max + 1.
        return tuple(math.ceil(round(scale, 6)) + 1 for scale in self.scales)

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """Table entries of each level, multiples of 8."""
        return tuple(min(-(-(res**3) // 8) * 8, 1 << self.log2_table) for res in self.resolutions)

    @cached_property
    def strides(self) -> tuple[int, ...]:
        """Vertices along an axis of each dense level, which stores them all; 0 of a hashed one."""
        shapes = zip(self.resolutions, self.sizes, strict=True)
        return tuple(res if res**3 <= size else 0 for res, size in shapes)

    @cached_property
    def offsets(self) -> tuple[int, ...]:
        """First table entry of each level, then the total number of entries."""
        return (0, *accumulate(self.sizes))

    @property
    def entries(self) -> int:
        """Number of entries of the whole table."""
        return self.offsets[-1]

    @property
    def channels(self) -> int:
        """Channels of an encoded position, level by level."""
        return self.levels * self.features


class SampleGradients(list[tuple[Tensor, Tensor]]):
    """Positions [N, 3] of samples and the gradients [N, levels * F] of their features, collected by
    the backward passes of a training step. The gradient of the table is a sum over them.
    `adam.hash_adam_` computes it, on a CPU level by level, and uses that of a level while it is in
    the cache."""

    def joined(self) -> TwoTensors:
        """All positions and gradients; there must be some."""
        positions, gradients = zip(*self, strict=True)
        return self[0] if len(self) == 1 else (torch.cat(positions), torch.cat(gradients))


class _Collect(torch.autograd.Function):
    """Lets features through; their gradient is added to `gradients`, and goes no further.

    `asking` asks for a gradient, without which there would be no backward pass."""

    @staticmethod
    def forward(ctx, features, asking, positions, gradients):
        ctx.save_for_backward(positions)
        ctx.gradients = gradients
        return features.view_as(features)

    @staticmethod
    def backward(ctx, gradient):
        ctx.gradients.append((*ctx.saved_tensors, gradient))
        return None, None, None, None


def collect(features: Tensor, positions: Tensor, gradients: SampleGradients) -> Tensor:
    """The `features` [N, levels * F] that `encode` computed at `positions` [N, 3] without a
    gradient, as part of the graph: the backward pass adds their gradient to `gradients`."""
    asking = torch.empty(0, device=features.device, requires_grad=True)
    return _Collect.apply(features, asking, positions, gradients)


def encode(
    positions: Tensor,
    table: Tensor,
    grid: HashGrid,
    *,
    packed: Tensor | None = None,
    gradients: SampleGradients | None = None,
    backend: str = "auto",
) -> Tensor:
    """Encode `positions` [N, 3] with `table` [entries, F]: [N, levels * F], level by level.

    Positions are clamped to [0, 1]. A position with a NaN gets NaN for all its features; it affects
    no other features and no gradient. Differentiable in `table`; in `positions` only with
    backend="reference".

    Args:
        packed: `pack(table)`; if given, it is read instead of `table` (half the memory traffic;
            F = 2 only). The output is then bfloat16; its gradient goes to `table`.
        gradients: if given, the gradients of the features are collected there and hidden from
            autograd, whether or not `table` asks for a gradient; `positions` get none.
    """
    check_shape("positions", positions, None, 3)
    check_shape("table", table, grid.entries, grid.features)
    if packed is not None:
        expect(grid.features == 2, "packed", "2 features an entry", grid.features)
        check_shape("packed", packed, grid.entries)
    read = table if gradients is None else table.detach()
    kernel = implementation(__name__, backend, positions.device)
    features = kernel.encode(positions, read, grid, packed)
    if gradients is not None:
        features = collect(features, positions, gradients)
    if hasattr(kernel, "MARKS_NAN"):
        return features
    # NaN is rare. On a CPU one sum tests for it cheaply; on a GPU, waiting for it would cost more.
    if positions.device.type != "cpu" or positions.sum().isnan():
        features = torch.where(positions.isnan().any(dim=1, keepdim=True), torch.nan, features)
    return features


def pack(table: Tensor) -> Tensor:
    """Pack two features as bfloat16 into an int32, the first one low: [entries, 2] -> [entries]."""
    check_shape("table", table, None, 2)
    return table.detach().to(torch.bfloat16).contiguous().view(torch.int32).squeeze(-1)
