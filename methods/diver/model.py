"""Features at the corners of sparse voxels, and the decoder of their integrals."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from bench.types import Rays
from methods.diver.decoder import CHANNELS, Decoder
from methods.diver.kernels.segments import segment_weights
from methods.instant_ngp.stage1 import TrainedField
from methods.kernels.corner_gather import corner_gather
from methods.kernels.encode import encode
from methods.kernels.types import Intervals
from methods.kernels.voxel_walk import Crossings, Voxels
from methods.students.voxels import corners_of, occupied_voxels
from methods.training import checkpoint


class CornerModel(nn.Module):
    """V voxels of a grid over the unit cube with features [C, 32] of their corners, and a decoder.

    Args:
        coordinates: [V, 3] int32, which voxels there are.
        resolution: voxels along the cube.
        decoder: decodes the integrals.
        backend: backend of the kernels.
    """

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
    def taught(
        cls, trained: TrainedField, resolution: int, generator: torch.Generator
    ) -> CornerModel:
        """Make a model with voxels where the trained field is occupied.

        The features of a corner are its hash encoding, 16 levels of 2, divided by their
        standard deviation; the decoder is random.

        Raises:
            ValueError: the encoding has more than 32 channels.
        """
        field = trained.field
        if field.grid.channels > CHANNELS:
            raise ValueError(
                f"a corner has {CHANNELS} features: expected a hash grid of at most as many "
                f"channels, got {field.grid.channels}; choose fewer levels or features"
            )
        coordinates = occupied_voxels(trained.occupancy, resolution)
        decoder = Decoder(generator).to(field.device)
        model = cls(coordinates, resolution, decoder, field.backend)
        with torch.no_grad():
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

    def tensors(self) -> dict[str, Tensor]:
        """Everything that was trained."""
        decoder = {f"decoder.{name}": value for name, value in self.decoder.state_dict().items()}
        return decoder | {"coordinates": self.voxels.coordinates, "table": self.table.detach()}

    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `tensors` returned, with as many voxels as there were."""
        self.decoder.load_state_dict(checkpoint.part(tensors, "decoder."))
        device = self.table.device
        self._place(tensors["coordinates"].to(device))
        self.table = nn.Parameter(tensors["table"].to(device, copy=True))


def as_intervals(crossings: Crossings) -> Intervals:
    """Intervals for `composite`: densities are integrated already, so every length is 1."""
    return Intervals(crossings.t, torch.ones_like(crossings.t), crossings.offsets)
