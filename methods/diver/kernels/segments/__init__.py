"""Segments, the parts of rays inside voxels that have features at their corners: the weights of the
corners in the mean of the features, and pixels (DIVeR: Wu et al. 2022, Sections 3.2 to 3.4).

The features of a segment are the mean of their trilinear interpolant along it. A small network
decodes them: they pass a ReLU and a hidden layer. One output is the density, integrated over the
segment already; the others, with the direction of the ray, give its colour. With backend="cpu",
layers whose width is no multiple of 16 raise ValueError.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from bench.types import Rays, check_shape
from methods.kernels.corner_gather import CORNERS
from methods.kernels.dispatch import implementation
from methods.kernels.settings import TRANSMITTANCE
from methods.kernels.types import Intervals, Pixels, check_rays
from methods.kernels.voxel_walk import Crossings, Voxels


@dataclass(frozen=True)
class Corners:
    """V voxels, and what they have at their corners, in the order of `corner_gather`."""

    voxels: Voxels
    rows: Tensor  # [V, 8] int32 rows of the table. Not checked.
    table: Tensor  # [C, F] features, float32 or bfloat16


@dataclass(frozen=True)
class Layers:
    """From F features of a segment, behind a ReLU, to its density and its colour: a ReLU follows
    every layer but the last, which a sigmoid follows. To the output of `geometry`, of the hidden
    layer, the direction of the ray is added."""

    hidden: Tensor  # [H, F]
    hidden_bias: Tensor  # [H]
    density: Tensor  # [1, H]
    density_bias: Tensor  # [1]
    geometry: Tensor  # [H, H]
    colour: Tensor  # [3, H]
    colour_bias: Tensor  # [3]


def as_intervals(crossings: Crossings) -> Intervals:
    """Intervals for `composite`: densities are integrated already, so every length is 1."""
    return Intervals(crossings.t, torch.ones_like(crossings.t), crossings.offsets)


def segment_weights(
    rays: Rays, crossings: Crossings, voxels: Voxels, *, backend: str = "auto"
) -> Tensor:
    """Weights [S, 8] of the corners in the means over the `crossings` of R `rays` through `voxels`:
    integrals of the trilinear interpolant along the segment, divided by its length (Section 3.2).
    Not differentiable."""
    check_rays(rays)
    kernel = implementation(__name__, backend, rays.origins.device)
    return kernel.segment_weights(rays, crossings, voxels)


def render_segments(
    rays: Rays,
    corners: Corners,
    layers: Layers,
    towards: Tensor,
    *,
    stop: float,
    faint: float = 0.0,
    backend: str = "auto",
) -> tuple[Pixels, Tensor, Tensor]:
    """The pixels of R `rays`, which end at the transmittance `stop`, without a background; segments
    with at most the weight `faint` have an opacity but no colour. Not differentiable. `towards` [R,
    H] is what the direction of a ray adds to the output of `layers.geometry`. Also returns how many
    segments of each ray lie in front of its end, and have a colour: [R] int32."""
    TRANSMITTANCE.check("stop", stop)
    hidden, features = layers.hidden.shape
    check_shape("rows", corners.rows, len(corners.voxels), CORNERS)
    check_shape("table", corners.table, None, features)
    check_shape("hidden_bias", layers.hidden_bias, hidden)
    check_shape("density", layers.density, 1, hidden)
    check_shape("density_bias", layers.density_bias, 1)
    check_shape("geometry", layers.geometry, hidden, hidden)
    check_shape("colour", layers.colour, 3, hidden)
    check_shape("colour_bias", layers.colour_bias, 3)
    check_shape("towards", towards, check_rays(rays), hidden)
    kernel = implementation(__name__, backend, rays.origins.device)
    return kernel.render_segments(rays, corners, layers, towards, stop, faint)
