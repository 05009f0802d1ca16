"""PlenOctree, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Literal

import torch
from torch import Tensor

from bench.study import Axis, Study, Variant, turned
from bench.types import Budget, Probe, Rays, Scene
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.types import Occupancy, Pixels, expect
from methods.plenoctree.kernels.voxel_light import render_voxels
from methods.plenoctree.octree import Extraction, Octree, extract
from methods.plenoctree.training import OctreeLessons, OctreeTraining
from methods.rendering.compaction import to_host
from methods.rendering.frame import Render
from methods.rendering.sampling import Sampling
from methods.students.method import Student


@dataclass(kw_only=True, eq=False)
class PlenOctree(Student):
    """A sparse grid of densities and spherical harmonics, extracted from a trained field and
    fine-tuned on the photos; its settings are explained in `sweeps/configs/method/plenoctree.yaml`.
    """

    training: OctreeLessons
    extraction: Extraction
    name: str = "plenoctree"
    stored: Literal["fp16", "fp32"] = "fp16"

    kind = "plenoctree"
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

    def __post_init__(self) -> None:
        super().__post_init__()
        expect(self.stored in ("fp16", "fp32"), "stored", "fp16 or fp32", self.stored)

    def model_settings(self) -> Mapping[str, object]:
        """The settings of the extraction."""
        return asdict(self.extraction)

    def begin(self, trained: TrainedField, scene: Scene, budget: Budget) -> OctreeTraining:
        """Extract an octree, and make its training."""
        setup = self.teacher
        generator = torch.Generator(setup.device).manual_seed(setup.seed)
        batches = PixelBatches(scene.splits["train"], setup.device)
        octree = extract(trained, batches, self.extraction, generator)
        return OctreeTraining(octree, scene, budget, self.training, setup.seed, setup.backend)

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Load the leaves that show anything, as they are stored."""
        self.octree = Octree.of(tensors, self.teacher.device).visible(self.stored)

    def renderer(self, probe: Probe) -> tuple[Occupancy, Render]:
        """The cells that hold leaves, and one pass through them."""
        octree, stop, backend = self.octree, self.stop, self.teacher.backend
        faint = Sampling(stop=stop).least_weight

        def render(_: Tensor, rays: Rays) -> Pixels:
            given = rays, octree.voxels, octree.light
            with probe.stage("render"):
                pixels, crossed, shaded = render_voxels(
                    *given, stop=stop, faint=faint, backend=backend
                )
                samples, shown = to_host([crossed.sum(), shaded.sum()])
            probe.count("samples", samples)
            probe.count("shaded_samples", shown, samples)
            return opaque_at_end(pixels, stop)

        return octree.occupancy, render

    def sizes(self) -> dict[str, int]:
        """Bytes of the leaves' values and of the index, as they are stored."""
        return self.octree.sizes(2 if self.stored == "fp16" else 4)

    def settings(self) -> dict[str, str]:
        return super().settings() | {"precision": self.stored}


def opaque_at_end(pixels: Pixels, stop: float) -> Pixels:
    """Make the rays opaque that ended at the transmittance `stop`, as the release's viewer does:
    their values are scaled to an opacity of 1."""
    ended = 1 - pixels.alpha <= stop
    scale = torch.where(ended, 1 / pixels.alpha, 1)
    alpha = torch.where(ended, 1, pixels.alpha)
    return Pixels(pixels.values * scale[:, None], pixels.depth_sum * scale, alpha)
