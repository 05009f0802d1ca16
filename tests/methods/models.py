"""Small models, fields and pipelines: a test names only what it is about."""

from functools import partial
from typing import Any

import numpy as np
import torch

from methods.instant_ngp.field import HashField
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.composite import STOP
from methods.kernels.encode import HashGrid
from methods.kernels.types import Occupancy
from methods.rendering.occupancy import DensityGrid
from methods.rendering.sampling import Sampling
from methods.steernerf.options import EVERYWHERE, MotionOptions
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.unet import UNet
from tests.common import ROOT, seeded
from tests.methods.usual import usual

RELEASE = np.load(ROOT / "tests/data/steernerf_release.npz")
"""What the released code computes: a U-Net on formulas, and two frames of 10 x 12 pixels, brought
into a third of 40 x 48."""

SMALL_GRID = HashGrid(levels=4, features=2, log2_table=8, n_min=4, n_max=16)
STEPS = {"step": 8.0, "stop": STOP}

small_model = partial(
    usual, "method/steernerf", "model", **STEPS, channels=4, feature_background=0.5
)
"""K = 4, L = 2, s = 4, long steps; options replace fields, here and below."""

small_rendering = partial(usual, "method/steernerf", "rendering", **STEPS, range=EVERYWHERE)
"""As `small_model()` is trained."""

small_motion = partial(MotionOptions, degrees=(0.0, 2.5), pool=12, uses=16)
"""An example serves 16 patches."""

small_joint = partial(
    usual,
    "method/steernerf",
    "joint",
    **{"field_rate": 1e-3, "final_rate": 1e-5, "patch": 32, "batch": 2, "jitter": False},
    **{"grid_samples": 0, "distilled_views": 100, "distilled_share": 0.5},
    motion=small_motion(),
)
"""Two patches of at most 32 x 32 a step."""


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
    generator = seeded(3)
    field = HashField(
        SMALL_GRID, channels, precision=precision, backend=backend, generator=generator
    )
    with torch.no_grad():
        field.table.uniform_(-1, 1, generator=generator)
        field.layers["density_out"][0] = 0.3
    field.repack()
    return field


def new_pipeline(**options: Any) -> Pipeline:
    """A misty field and an untrained U-Net on white; always the same weights."""
    torch.manual_seed(0)
    model = small_model(**options)
    field = misty_field(channels=model.channels)
    unet = UNet(model.channels, model.frames, model.scale, width=4, aligned=True)
    return Pipeline(trained_field(field), torch.ones(3), unet, model)


def shaken(renderer: UNet) -> UNet:
    """The renderer with no weight that is 0, as after some training."""
    generator = seeded(0)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return renderer
