"""DIVeR (Wu et al. 2022), as a `bench.types.Method`: what is baked for a frame (Section 3.4)."""

from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor
from torch.nn import functional

from bench.study import Axis, Study, Variant, turned
from bench.types import Budget, Probe, Rays, Scene
from methods.diver.kernels.segments import Corners, Layers, render_segments
from methods.diver.model import CornerModel, Decoder
from methods.diver.training import DiverLessons, DiverTraining
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.corner_gather import CORNERS
from methods.kernels.settings import Fraction, multiple
from methods.kernels.types import Occupancy, Pixels
from methods.rendering.compaction import to_host
from methods.rendering.frame import Renderer
from methods.students.method import IN_FP32, Student
from methods.students.networks import encode_directions
from methods.training.checkpoint import Tensors

Stored = Literal["bf16", "fp32"]


class Baked:
    """A trained model as it is rendered, with features of the corners in the type `stored`.

    Integration is linear and its weights add up to 1, so the first layer of the decoder may come
    before it: it is already applied to the corners. No ReLU separates the 32 outputs of the third
    layer from the layer of the directions: the two are merged.
    """

    @torch.no_grad()
    def __init__(self, model: CornerModel, stored: Stored) -> None:
        decoder = model.decoder
        table = functional.linear(model.table, decoder.first.weight, decoder.first.bias)
        table = table.to(torch.bfloat16 if stored == "bf16" else torch.float32)
        self.corners, self.backend = Corners(model.voxels, model.corners, table), model.backend
        self.occupancy = Occupancy.at(model.voxels.coordinates, model.resolution)
        along, across = decoder.view_parts()
        third, bias = decoder.third.weight, decoder.third.bias
        self.layers = Layers(
            hidden=decoder.second.weight.detach(),
            hidden_bias=decoder.second.bias.detach(),
            density=third[:1],
            density_bias=bias[:1],
            geometry=along @ third[1:],
            colour=decoder.colour.weight.detach(),
            colour_bias=decoder.colour.bias.detach(),
        )
        self.across, self.view_bias = across.clone(), decoder.view.bias + along @ bias[1:]

    def sizes(self) -> dict[str, int]:
        """Bytes of the features, of a bit per cell that marks voxels, and of the decoder."""
        decoder = (*vars(self.layers).values(), self.across, self.view_bias)
        return {
            "corners": self.corners.table.numel() * self.corners.table.element_size(),
            "voxels": self.occupancy.cells.numel() // 8,
            "decoder": 4 * sum(part.numel() for part in decoder),
        }

    @torch.no_grad()
    def render_rays(self, rays: Rays, probe: Probe, stop: float, faint: float) -> Pixels:
        """Render R `rays`, not composited on a background, with `stop` and `faint` as for
        `render_segments`."""
        layers = self.layers
        with probe.stage("segments"):
            encoded = encode_directions(rays.directions)
            towards = functional.linear(encoded, self.across, self.view_bias)
            pixels, crossed, shaded = render_segments(
                rays, self.corners, layers, towards, stop=stop, faint=faint, backend=self.backend
            )
        segments, colours = to_host([crossed.sum(), shaded.sum()])
        probe.count("segments", segments)
        probe.count("shaded_segments", colours, segments)
        probe.count("table_reads", CORNERS * segments)
        density = layers.hidden.numel() + layers.density.numel()
        colour = layers.geometry.numel() + layers.colour.numel()
        directions = self.across.numel() * len(rays.origins)
        probe.count("products", segments * density + colours * colour + directions)
        return pixels


@dataclass(kw_only=True, eq=False)
class Diver(Student):
    """Corner features of sparse voxels, integrated along rays and decoded by a small network; its
    settings are explained in `sweeps/configs/method/diver.yaml`."""

    training: DiverLessons
    resolution: Annotated[int, multiple(16, 512)]  # cells are looked up in bricks of bricks
    stored: Stored
    faint: Fraction

    kind, model, computed = "diver", ("resolution",), IN_FP32
    contracts = False
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

    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> DiverTraining:
        model = CornerModel.taught(teacher, self.resolution, self.teacher.generator())
        return DiverTraining(model, scene, budget, self.training, self.teacher.seed)

    def restore(self, tensors: Tensors) -> None:
        device = self.teacher.device
        blank = torch.zeros(0, 3, dtype=torch.int32, device=device)
        model = CornerModel(blank, self.resolution, Decoder().to(device), self.teacher.backend)
        model.restore(tensors)
        self.baked = Baked(model, self.stored)

    def renderer(self, probe: Probe) -> Renderer:
        def render(_: Tensor, rays: Rays) -> Pixels:
            return self.baked.render_rays(rays, probe, self.stop, self.faint)

        return self.baked.occupancy, render

    def sizes(self) -> dict[str, int]:
        return self.baked.sizes()
