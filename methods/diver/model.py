"""Features at the corners of sparse voxels, and the decoder of their integrals (Wu et al. 2022)."""

from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Rays, TwoTensors
from methods.diver.kernels.segments import segment_weights
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.corner_gather import corner_gather
from methods.kernels.encode import encode
from methods.kernels.types import expect
from methods.kernels.voxel_walk import Crossings, Voxels
from methods.students.networks import DIRECTION_CHANNELS, Dense
from methods.students.voxels import corners_of, occupied_voxels
from methods.training import checkpoint
from methods.training.checkpoint import Tensors

CHANNELS = 32  # features of a corner, and width of every layer between input and output


class Decoder(nn.Module):
    """DIVeR32 (Section 3.3): a 32-32-32-33 network of integrated features, and a (32 + 27)-32-3
    network of its last 32 outputs and the direction. ReLU between the layers of each, but not
    between the two."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        self.first = Dense(CHANNELS, CHANNELS, "fp32", generator)
        self.second = Dense(CHANNELS, CHANNELS, "fp32", generator)
        self.third = Dense(CHANNELS, 1 + CHANNELS, "fp32", generator)
        self.view = Dense(CHANNELS + DIRECTION_CHANNELS, CHANNELS, "fp32", generator)
        self.colour = Dense(CHANNELS, 3, "fp32", generator)

    def density(self, features: Tensor) -> TwoTensors:
        """Density [S], integrated over the segment, before its ReLU; and what `colours` needs
        [S, 32]."""
        hidden = self.second(self.first(features).relu()).relu()
        sigma, geometry = self.third(hidden).split((1, CHANNELS), dim=1)
        return sigma.squeeze(1), geometry

    def view_parts(self) -> TwoTensors:
        """Weights of the geometry [32, 32] and of the direction [32, 27] in the layer `view`."""
        return self.view.weight.split((CHANNELS, DIRECTION_CHANNELS), dim=1)

    def colours(self, geometry: Tensor, encoded: Tensor, ray: Tensor) -> Tensor:
        """RGB [S, 3] in [0, 1] on rays `ray` [S] of encoded directions [R, 27]."""
        along, across = self.view_parts()
        # This layer is linear: the product of the directions is computed only once per ray.
        towards = functional.linear(encoded, across, self.view.bias)
        hidden = functional.linear(geometry, along) + towards.index_select(0, ray)
        return self.colour(hidden.relu()).sigmoid()


class CornerModel(nn.Module):
    """V voxels of a grid over the unit cube, at `coordinates` [V, 3] int32, with features [C, 32]
    of their corners, and a decoder."""

    table: nn.Parameter

    def __init__(
        self, coordinates: Tensor, resolution: int, decoder: Decoder, backend: str
    ) -> None:
        super().__init__()
        self.resolution, self.decoder, self.backend = resolution, decoder, backend
        self._place(coordinates)
        blank = torch.zeros(len(self.vertices), CHANNELS, device=coordinates.device)
        self.table = nn.Parameter(blank)

    @classmethod
    @torch.no_grad()
    def taught(cls, teacher: TrainedField, resolution: int, generator: torch.Generator) -> Self:
        """Make a model with voxels where the trained field is occupied, and a random decoder. The
        features of a corner are its hash encoding, 16 levels of 2, divided by their standard
        deviation; ValueError if it has more than 32 channels."""
        field = teacher.field
        few = f"at most the {CHANNELS} channels of a corner: choose fewer levels or features"
        expect(field.grid.channels <= CHANNELS, "grid", few, field.grid.channels)
        coordinates = occupied_voxels(teacher.occupancy, resolution)
        model = cls(coordinates, resolution, Decoder(generator).to(field.device), field.backend)
        positions = model.vertices / resolution
        features = encode(positions, field.table, field.grid, backend=field.backend)
        model.table[:, : features.shape[1]] = features / features.std().clamp(min=1e-8)
        return model

    def _place(self, coordinates: Tensor) -> None:
        self.voxels = Voxels(coordinates, self.resolution)
        self.corners, self.vertices = corners_of(coordinates)

    def keep(self, voxels: Tensor) -> Tensor:
        """Keep only some voxels ([V] bool); return the rows [C'] of the corners that are left."""
        rows = self.corners[voxels].unique()  # in the order that `_place` gives them
        self._place(self.voxels.coordinates[voxels])
        self.table = nn.Parameter(self.table.detach()[rows.long()])
        return rows

    def weights(self, rays: Rays, crossings: Crossings) -> Tensor:
        """Weights [S, 8] of the corners in the integrals over `crossings` of `rays`."""
        return segment_weights(rays, crossings, self.voxels, backend=self.backend)

    def features(self, voxel: Tensor, weights: Tensor, grad_buffer: Tensor | None = None) -> Tensor:
        """Integrals [S, 32] of features over segments in voxels [S]."""
        return corner_gather(
            self.table, self.corners, voxel, weights, grad_buffer=grad_buffer, backend=self.backend
        )

    def tensors(self) -> Tensors:
        """Everything that was trained."""
        own = {"coordinates": self.voxels.coordinates, "table": self.table.detach()}
        return self.decoder.state_dict(prefix="decoder.") | own

    def restore(self, tensors: Tensors) -> None:
        """Restore what `tensors` returned."""
        self.decoder.load_state_dict(checkpoint.part(tensors, "decoder."))
        device = self.table.device
        self._place(tensors["coordinates"].to(device))
        self.table = nn.Parameter(tensors["table"].to(device, copy=True))
