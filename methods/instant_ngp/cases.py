"""The whole training step of a field as a case: what the kernels are worth together."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from bench.types import Budget, Camera, Scene, Split
from methods.instant_ngp.field import HashField
from methods.instant_ngp.training import FieldTraining, TrainingOptions
from methods.kernels.case import U16, Case, Prepared
from methods.kernels.encode import HashGrid
from methods.kernels.march import Occupancy
from methods.rendering.occupancy import RESOLUTION

SAMPLES = 1 << 15
RAYS = 3000
"""Rays that bring about `SAMPLES` samples in the hollow sphere below."""


def cases() -> list[Case]:
    """One step of a young field around a hollow sphere, the same batch for every backend."""
    return [Case("training step", "T=2^17", "bf16", SAMPLES, _prepare, timed=True)]


def _prepare(device: str) -> Prepared:
    trainings: dict[str, FieldTraining] = {}
    scene, occupancy = _noise_scene(), _hollow_sphere(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        if backend not in trainings:
            generator = torch.Generator().manual_seed(0)
            field = HashField(HashGrid(log2_table=17), backend=backend, generator=generator)
            budget = Budget("step", steps=1000, samples=SAMPLES)
            trainings[backend] = FieldTraining(
                field.to(device), scene, budget, TrainingOptions(), seed=0
            )
        training = trainings[backend]
        # The same batch in the same grid, at a step that does not update the grid.
        training.step, training.rays = 1, RAYS
        training.generator.manual_seed(0)
        training.grid.occupancy = occupancy
        return (torch.tensor(training.advance()[""]),)

    # The loss, below 1, of pixels behind five bfloat16 layers.
    return Prepared(call, 5 * U16)


def _hollow_sphere(device: str) -> Occupancy:
    axis = (torch.arange(RESOLUTION, device=device) + 0.5) / RESOLUTION - 0.5
    radius = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2).sqrt()
    return Occupancy((radius > 0.33) & (radius < 0.35))


def _noise_scene() -> Scene:
    """Pictures of noise, taken on a circle around the unit cube."""
    generator = torch.Generator().manual_seed(0)
    cameras, images = [], []
    for view in range(8):
        angle = math.pi * view / 4
        forward = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        down = torch.tensor([0.0, 0.0, -1.0])
        rotation = torch.stack((torch.linalg.cross(down, forward), down, forward), dim=1)
        c2w = torch.cat((rotation, (0.5 - 1.3 * forward)[:, None]), dim=1)
        cameras.append(Camera(c2w, 70.0, 70.0, 32.0, 32.0, 64, 64))
        images.append(torch.randint(256, (64, 64, 4), dtype=torch.uint8, generator=generator))
    split = Split(cameras, images, [str(view) for view in range(8)])
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("noise", {"train": split, "test": split}, torch.ones(3), bounds, 1.0, "noise")
