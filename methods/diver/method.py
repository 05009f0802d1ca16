"""DIVeR (Wu et al. 2022), as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from bench.study import Axis, Study, Variant, turned
from bench.types import Budget, Probe, Rays, Scene
from methods.diver.model import CornerModel, Decoder
from methods.diver.rendering import Baked, Stored
from methods.diver.training import DiverLessons, DiverTraining
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.types import Occupancy, Pixels, expect
from methods.rendering.frame import Render
from methods.students.method import Student

MULTIPLE = 16
"""The resolution is a multiple of this: its cells are looked up in bricks of bricks."""

FINEST = 512


@dataclass(kw_only=True, eq=False)
class Diver(Student):
    """Corner features of sparse voxels, integrated along rays and decoded by a small network; its
    settings are explained in `sweeps/configs/method/diver.yaml`."""

    training: DiverLessons
    name: str = "diver"
    resolution: int = 256
    stored: Stored = "bf16"
    faint: float = 1e-2

    kind = "diver"
    study = Study(
        knobs={
            "stop": turned("stop", "method.stop", ("1e-1", "1e-3", "1e-4")),
            "faint": turned("faint", "method.faint", ("0", "1e-3", "1e-1")),
            "stored": [Variant("stored fp32", ("method.stored=fp32",))],
        },
        exact=("method.stop=1e-4", "method.faint=0", "method.stored=fp32"),
        parts=dict.fromkeys(("rays", "segments"), "field"),
        axes={"G": Axis("{} voxels a side", "method.resolution", (128, 192, 256))},
        chosen=("stored", "faint", "stop"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        size = self.resolution
        whole = MULTIPLE <= size <= FINEST and not size % MULTIPLE
        expect(whole, "resolution", f"a multiple of {MULTIPLE} up to {FINEST}", size)
        expect(self.stored in ("bf16", "fp32"), "stored", "bf16 or fp32", self.stored)
        expect(0 <= self.faint < 1, "faint", "a weight of 0 or more and less than 1", self.faint)

    def model_settings(self) -> Mapping[str, object]:
        """The number of voxels."""
        return {"resolution": self.resolution}

    def begin(self, trained: TrainedField, scene: Scene, budget: Budget) -> DiverTraining:
        """Make the training of corners that start as the trained field encodes them."""
        generator = torch.Generator().manual_seed(self.teacher.seed)
        model = CornerModel.taught(trained, self.resolution, generator)
        return DiverTraining(model, scene, budget, self.training, self.teacher.seed)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Load a model, and bake it."""
        device = self.teacher.device
        blank = torch.zeros(0, 3, dtype=torch.int32, device=device)
        model = CornerModel(blank, self.resolution, Decoder().to(device), self.teacher.backend)
        model.load(tensors)
        self.baked = Baked(model, self.stored)

    def renderer(self, probe: Probe) -> tuple[Occupancy, Render]:
        """The cells of its voxels, and the baked model."""

        def render(_: Tensor, rays: Rays) -> Pixels:
            return self.baked.render_rays(rays, probe, self.stop, self.faint)

        return self.baked.occupancy, render

    def sizes(self) -> dict[str, int]:
        """Bytes of what `Baked` renders."""
        return self.baked.sizes()

    def settings(self) -> dict[str, str]:
        return super().settings() | {"precision": self.stored}
