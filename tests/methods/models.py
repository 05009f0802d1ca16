"""Small models, fields and pipelines: a test names only what it is about."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from methods.instant_ngp.field import HashField
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.composite import STOP
from methods.kernels.encode import HashGrid
from methods.kernels.types import Occupancy
from methods.rendering.occupancy import DensityGrid
from methods.rendering.sampling import Sampling
from methods.steernerf.options import Model, Rendering, Reprojection
from methods.steernerf.pipeline import Pipeline
from methods.steernerf_lean.lean_renderer import LeanRenderer

SMALL_GRID = HashGrid(levels=4, log2_table=8, n_min=4, n_max=16)


def small_model(**others: Any) -> Model:
    """K = 4, L = 2, s = 4, long steps; `others` replace fields."""
    fields: dict[str, Any] = {
        "channels": 4,
        "frames": 2,
        "scale": 4,
        "step": 8.0,
        "stop": STOP,
        "reprojection": Reprojection(),
        "feature_background": 0.5,
        "history": True,
        "surface": True,
    }
    return Model(**fields | others)


def small_rendering(**others: Any) -> Rendering:
    """As `small_model()` is trained, but without refinement; `others` replace fields."""
    return replace(Rendering.in_training(small_model(), refined=0.0, refined_step=1.0), **others)


def shell() -> Occupancy:
    """Where the surface of the ball is, and a little more."""
    axis = (torch.arange(32) + 0.5) / 32 - 0.5
    radius = torch.cartesian_prod(axis, axis, axis).norm(dim=1).view(32, 32, 32)
    return Occupancy((radius - 0.3).abs() < 0.06)


def trained_field(field: HashField) -> TrainedField:
    """In place of a trained field: `field`, around the surface of the ball."""
    return TrainedField(field, DensityGrid(shell().cells), Sampling(), train_s=0.0)


def misty_field(precision: str = "bf16", backend: str = "auto", channels: int = 4) -> HashField:
    """A field in which every sample matters: density of about 10, features all different."""
    generator = torch.Generator().manual_seed(3)
    field = HashField(
        SMALL_GRID, channels, precision=precision, backend=backend, generator=generator
    )
    with torch.no_grad():
        field.table.uniform_(-1, 1, generator=generator)
        field.layers["density_out"][0] = 0.3
    field.repack()
    return field


def small_renderer(model: Model, *, width: int = 8) -> LeanRenderer:
    """An untrained lean 2D renderer of one block for `model`."""
    return LeanRenderer(
        model.channels,
        model.frames,
        model.scale,
        width=width,
        blocks=1,
        init="scratch",
        history=model.history,
        surface=model.surface,
    )


def new_pipeline(model: Model | None = None) -> Pipeline:
    """A misty field and an untrained 2D renderer on white; always the same weights."""
    torch.manual_seed(0)
    model = model or small_model()
    field = misty_field(channels=model.channels)
    return Pipeline(field, shell(), torch.ones(3), small_renderer(model), model)
