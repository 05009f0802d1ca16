"""PlenOctree, as a `bench.types.Method`: its leaves learn from random rays of the photos, with Adam
(Yu et al. 2021, Section 4.2)."""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from bench.study import Axis, Study, Variant, turned
from bench.types import Budget, Probe, Rays, Scene
from methods.instant_ngp.pixels import PixelBatches
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.instant_ngp.training import PixelOptions, PixelTraining
from methods.kernels.adam import AdamState, sparse_adam_
from methods.kernels.composite import STOP, composite, visibility
from methods.kernels.settings import Count, NotNegative
from methods.kernels.types import Composited, Pixels
from methods.kernels.voxel_walk import walk
from methods.plenoctree.kernels.voxel_light import render_voxels, shade_voxels
from methods.plenoctree.octree import Extraction, Octree, extract
from methods.rendering.compaction import to_host
from methods.rendering.frame import Renderer
from methods.rendering.sampling import Sampling
from methods.students.method import IN_FP32, Student
from methods.training.checkpoint import Optimisers, Tensors

SIDE = "method.extraction.resolution"


@dataclass(frozen=True)
class OctreeLessons(PixelOptions):
    """How to train leaves, as `sweeps/configs/method/plenoctree.yaml` explains. `rate` is that of
    the harmonics; `samples` are more than those of a field, each of which changes the whole
    network."""

    density_rate: NotNegative
    samples: Count


class OctreeTraining(PixelTraining):
    """Trains the leaves that rays see; their set is fixed."""

    options: OctreeLessons

    def __init__(
        self, octree: Octree, scene: Scene, budget: Budget, options: OctreeLessons, setup: Setup
    ) -> None:
        steps, samples = budget.renderer_steps, options.samples
        super().__init__(scene, setup.device, steps, samples, options, setup.seed)
        self.backend = setup.backend
        self._take(octree)

    def _take(self, octree: Octree) -> None:
        self.octree, light = octree, octree.light
        # As tables of one and of 3 C columns, for Adam.
        self.tables = {"density": light.density[:, None], "harmonics": light.harmonics.flatten(1)}
        self.gradients = {name: torch.zeros_like(table) for name, table in self.tables.items()}
        self.moments = {name: AdamState.like(table) for name, table in self.tables.items()}

    def _render(self, rays: Rays, jitter: Tensor, background: Tensor) -> Composited:
        # `jitter` moves samples; where a ray crosses a voxel is fixed.
        light, backend = self.octree.light, self.backend
        crossings = walk(rays, self.octree.voxels, backend=backend)
        sigma = light.density[crossings.voxel].relu()
        seen = visibility(sigma, crossings, stop=STOP, backend=backend)
        crossings = crossings.front(seen.counts)
        self._sigma = light.density[crossings.voxel].requires_grad_()
        self.visited = crossings.voxel  # [S] int32
        where = crossings.voxel, crossings.ray, functional.normalize(rays.directions, dim=1)
        buffer = self.gradients["harmonics"].view_as(light.harmonics)
        colours = shade_voxels(light.harmonics, *where, grad_buffer=buffer, backend=backend)
        pixels = composite(self._sigma.relu(), colours, crossings, stop=STOP, backend=backend)
        return pixels.over(background), len(crossings)

    def optimisers(self) -> Optimisers:
        return self.moments

    def _update(self) -> None:
        if self._sigma.grad is not None:
            self.gradients["density"].view(-1).index_add_(0, self.visited, self._sigma.grad)
        rate = self.learning_rate()
        # A leaf's optical thickness is its density times its width.
        width = 1 / self.octree.voxels.resolution
        rates = {"harmonics": rate, "density": rate / self.options.rate}
        rates["density"] *= self.options.density_rate / width
        for name, table in self.tables.items():
            given = table, self.gradients[name], self.moments[name], rates[name]
            sparse_adam_(*given, backend=self.backend)

    def watched(self) -> Tensors:
        return self.tables

    def result(self) -> Tensors:
        return self.octree.tensors()

    def restore_result(self, tensors: Tensors) -> None:
        self._take(Octree.of(tensors, self.octree.light.density.device))


@dataclass(kw_only=True, eq=False)
class PlenOctree(Student):
    """A sparse grid of densities and spherical harmonics, extracted from a trained field and
    fine-tuned on the photos; `sweeps/configs/method/plenoctree.yaml` explains its settings."""

    training: OctreeLessons
    extraction: Extraction
    stored: Literal["fp16", "fp32"]

    kind, model, computed = "plenoctree", ("extraction",), IN_FP32
    contracts = False
    study = Study(
        knobs={
            "stop": turned("stop", "method.stop", ("1e-1", "1e-3", "1e-4")),
            "stored": [Variant("stored fp32", ("method.stored=fp32",))],
        },
        trained={"resolution, trained": [Variant(f"{n}³", (f"{SIDE}={n}",)) for n in (128, 256)]},
        exact=("method.stop=1e-4", "method.stored=fp32"),
        parts=dict.fromkeys(("rays", "render"), "field"),
        axes={"G": Axis("{}³ leaves", SIDE, (128, 256, 512))},
        chosen=("stored", "stop"),
    )

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> OctreeTraining:
        setup = self.teacher
        batches = PixelBatches(scene.splits["train"], setup.device)
        octree = extract(teacher, batches, self.extraction, setup.generator(setup.device))
        return OctreeTraining(octree, scene, budget, self.training, setup)

    def restore(self, tensors: Tensors) -> None:
        self.octree = Octree.of(tensors, self.teacher.device).visible(self.stored)

    def renderer(self, probe: Probe) -> Renderer:
        octree, stop, backend = self.octree, self.stop, self.teacher.backend
        faint = Sampling(stop=stop).least_weight

        def render(_: Tensor, rays: Rays) -> Pixels:
            with probe.stage("render"):
                pixels, crossed, shaded = render_voxels(
                    rays, octree.voxels, octree.light, stop=stop, faint=faint, backend=backend
                )
                samples, shown = to_host([crossed.sum(), shaded.sum()])
            probe.count("samples", samples)
            probe.count("shaded_samples", shown, samples)
            return opaque_at_end(pixels, stop)

        return octree.occupancy, render

    def sizes(self) -> dict[str, int]:
        return self.octree.sizes(2 if self.stored == "fp16" else 4)


def opaque_at_end(pixels: Pixels, stop: float) -> Pixels:
    """Make the rays opaque that ended at the transmittance `stop`, as the release's viewer does:
    their values are scaled to an opacity of 1."""
    ended = 1 - pixels.alpha <= stop
    scale = torch.where(ended, 1 / pixels.alpha, 1)
    alpha = torch.where(ended, 1, pixels.alpha)
    return Pixels(pixels.values * scale[:, None], pixels.depth_sum * scale, alpha)
