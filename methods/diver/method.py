"""DIVeR (Wu et al. 2022), as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from bench.study import Axis, Study, Variant, turned
from bench.types import Budget, Probe, Rays, Scene
from methods.diver.decoder import Decoder
from methods.diver.model import CornerModel
from methods.diver.rendering import Baked, Stored
from methods.diver.training import DiverLessons, DiverTraining
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.kernels.types import Occupancy, Pixels
from methods.rendering.frame import Render
from methods.students.method import Student

MULTIPLE = 16
"""The resolution is a multiple of this: its cells are looked up in bricks of bricks."""

FINEST = 512


class Diver(Student):
    """Corner features of sparse voxels, integrated along rays and decoded by a small network.

    Args:
        teacher: the field that it starts from, and where it runs.
        training: how corners and decoder are trained.
        resolution: voxels along the unit cube, a multiple of 16, at most 512.
        stored: "bf16" or "fp32", the precision of the corners' features when rendering.
        faint: weight below which a segment has an opacity but no colour.
        stop: transmittance at which a ray ends when rendering, less than 1.
        name: as shown in result rows.
        steps: steps of its own training; None: `budget.renderer_steps`.
    """

    kind = "diver"
    training: DiverLessons
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

    def __init__(
        self,
        *,
        teacher: Setup,
        training: DiverLessons,
        resolution: int = 256,
        stored: Stored = "bf16",
        faint: float = 1e-2,
        stop: float = 1e-2,
        name: str = "diver",
        steps: int | None = None,
    ) -> None:
        super().__init__(teacher, training, stop, name, steps)
        if resolution % MULTIPLE or not MULTIPLE <= resolution <= FINEST:
            raise ValueError(
                f"resolution: expected a multiple of {MULTIPLE} up to {FINEST}, got {resolution}"
            )
        if stored not in ("bf16", "fp32"):
            raise ValueError(f"stored: expected bf16 or fp32, got {stored!r}")
        if not 0 <= faint < 1:
            raise ValueError(f"faint: expected a weight of 0 or more and less than 1, got {faint}")
        self.resolution, self.stored, self.faint = resolution, stored, faint

    def model_settings(self) -> Mapping[str, object]:
        """See `Student`."""
        return {"resolution": self.resolution}

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> DiverTraining:
        """See `Student`."""
        generator = torch.Generator().manual_seed(self.teacher.seed)
        model = CornerModel.taught(teacher, self.resolution, generator)
        return DiverTraining(model, scene, budget, self.training, self.teacher.seed)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """See `Student`."""
        device = self.teacher.device
        blank = torch.zeros(0, 3, dtype=torch.int32, device=device)
        model = CornerModel(blank, self.resolution, Decoder().to(device), self.teacher.backend)
        model.load(tensors)
        self.baked = Baked(model, self.stored)

    def renderer(self, probe: Probe) -> tuple[Occupancy, Render]:
        """See `Student`."""

        def render(_: Tensor, rays: Rays) -> Pixels:
            return self.baked.render_rays(rays, probe, self.stop, self.faint)

        return self.baked.occupancy, render

    def sizes(self) -> dict[str, int]:
        """Bytes of what `Baked` renders."""
        return self.baked.sizes()

    def settings(self) -> dict[str, str]:
        """See `bench.types.Method.settings`."""
        return super().settings() | {"precision": self.stored}
