"""PlenOctree, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Literal

import torch
from torch import Tensor

from bench.study import Axis, Study, Variant, turned
from bench.types import Budget, Probe, Rays, Scene
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.kernels.types import Occupancy, Pixels
from methods.kernels.voxel_walk import render_voxels
from methods.plenoctree.octree import Octree
from methods.plenoctree.start import Extraction, extract
from methods.plenoctree.training import OctreeLessons, OctreeTraining
from methods.rendering.compaction import to_host
from methods.rendering.frame import Render
from methods.rendering.march import March
from methods.students.method import Student

Stored = Literal["fp16", "fp32"]


class PlenOctree(Student):
    """A sparse grid of densities and spherical harmonics, extracted from a trained field and
    fine-tuned on the photos.

    Args:
        teacher: the field that it is extracted from.
        extraction: which leaves there are, and their initial values.
        training: how they are trained.
        stored: precision of the values in a file, at which they are also rendered.
        stop: transmittance at which a ray ends, less than 1.
        name: as shown in result rows.
        steps: steps of its own training; None: `budget.renderer_steps`.
    """

    kind = "plenoctree"
    training: OctreeLessons
    study = Study(
        knobs={
            "stop": turned("stop", "method.stop", ("1e-1", "1e-3", "1e-4")),
            "stored": [Variant("stored fp32", ("method.stored=fp32",))],
        },
        trained={
            "resolution, trained": [
                Variant(f"{n}³", (f"method.extraction.resolution={n}",)) for n in (128, 256)
            ]
        },
        exact=("method.stop=1e-4", "method.stored=fp32"),
        parts=dict.fromkeys(("rays", "render"), "field"),
        axes={"G": Axis("{}³ leaves", "method.extraction.resolution", (128, 256, 512))},
        chosen=("stored", "stop"),
    )

    def __init__(
        self,
        *,
        teacher: Setup,
        extraction: Extraction,
        training: OctreeLessons,
        stored: Stored = "fp16",
        stop: float = 1e-2,
        name: str = "plenoctree",
        steps: int | None = None,
    ) -> None:
        if stored not in ("fp16", "fp32"):
            raise ValueError(f"stored: expected fp16 or fp32, got {stored!r}")
        super().__init__(teacher, training, stop, name, steps)
        self.extraction, self.stored = extraction, stored

    def model_settings(self) -> Mapping[str, object]:
        """See `Student`: the settings of the extraction."""
        return asdict(self.extraction)

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> OctreeTraining:
        """See `Student`."""
        setup = self.teacher
        generator = torch.Generator(setup.device).manual_seed(setup.seed)
        batches = PixelBatches(scene.splits["train"], setup.device)
        octree = extract(teacher, batches, self.extraction, generator)
        return OctreeTraining(octree, scene, budget, self.training, setup.seed, setup.backend)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """See `Student`."""
        octree = Octree.of(tensors, self.teacher.device)
        self.octree = octree.rounded() if self.stored == "fp16" else octree.visible()

    def renderer(self, probe: Probe) -> tuple[Occupancy, Render]:
        """See `Student`."""
        octree = self.octree

        def render(_: Tensor, rays: Rays) -> Pixels:
            with probe.stage("render"):
                pixels, crossed, shaded = render_voxels(
                    rays,
                    octree.voxels,
                    octree.light,
                    stop=self.stop,
                    faint=March(stop=self.stop).least_weight,
                    backend=self.teacher.backend,
                )
                samples, shown = to_host([crossed.sum(), shaded.sum()])
            probe.count("samples", samples)
            probe.count("shaded_samples", shown, samples)
            return opaque_at_end(pixels, self.stop)

        return octree.occupancy, render

    def sizes(self) -> dict[str, int]:
        """Bytes of the leaves' values and of the index, as they are stored."""
        return self.octree.sizes(2 if self.stored == "fp16" else 4)

    def settings(self) -> dict[str, str]:
        """See `bench.types.Method.settings`."""
        return super().settings() | {"precision": self.stored}


def opaque_at_end(pixels: Pixels, stop: float) -> Pixels:
    """Make the rays opaque that ended at the transmittance `stop`, as the release's viewer does:
    their values are scaled to an opacity of 1."""
    ended = 1 - pixels.alpha <= stop
    scale = torch.where(ended, 1 / pixels.alpha, 1)
    return Pixels(
        pixels.values * scale[:, None],
        pixels.depth_sum * scale,
        torch.where(ended, 1, pixels.alpha),
    )
