"""Which samples of rays are kept, when those of a ray come in several pieces."""

from __future__ import annotations

from torch import Tensor

from bench.types import check_shape
from methods.kernels.dispatch import implementation


def keep(
    starts: Tensor,
    counts: Tensor,
    turns: Tensor,
    thin: Tensor,
    every: int,
    *,
    backend: str = "auto",
) -> tuple[Tensor, Tensor]:
    """Choose samples of R rays. A ray has K pieces, one behind the other.

    S samples lie in stretches, each of one ray. A piece is the first `counts` samples of a stretch;
    the others are never kept. The samples in the pieces of a ray are numbered from its turn on, and
    thin ones are kept if `every` divides their number.

    Args:
        starts: [K, R] int64, where each stretch starts, the first of all at 0; those of a ray lie
            one behind the other, and one that it lacks starts at S.
        counts: [K, R] int64, at most the length of the stretch.
        turns: [R] int32, not negative.
        thin: [S] bool.
        every: at least 1.

    Returns:
        The indices [N] int64 of the samples that are kept, ray by ray, front to back; and how many
        each ray has, [R] int64. The host waits for a GPU.
    """
    pieces, rays = starts.shape
    check_shape("counts", counts, pieces, rays)
    check_shape("turns", turns, rays)
    check_shape("thin", thin, None)
    if every < 1:
        raise ValueError(f"every: expected 1 or more, got {every}")
    kernel = implementation(__name__, backend, starts.device)
    kept: tuple[Tensor, Tensor] = kernel.keep(starts, counts, turns, thin, every)
    return kept
