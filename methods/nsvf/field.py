"""Embeddings at the corners of sparse voxels and the network that reads them, as a field."""

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe, TwoTensors
from methods.instant_ngp.field import FieldPrecision
from methods.kernels.corner_gather import CORNERS, corner_gather, trilinear
from methods.kernels.types import Occupancy
from methods.students.networks import Dense, NetworkField, density_of, positional, products
from methods.students.voxels import corners_of

EMBEDDING = 32  # channels at a corner

WIDTH = 256
DENSITY_WIDTH = 128
EMBEDDING_FREQUENCIES = 6
DIRECTION_FREQUENCIES = 4

FREE_ENERGY = 7.0  # factor by which the release multiplies lengths before it computes the opacity

ACROSS = 3.0
"""Side of the cube, approximately, in the units of the published scenes, in which the release
measures lengths."""


class Norm(nn.LayerNorm):
    """LayerNorm in the dtype of its inputs; means and variances are float32 all the same."""

    def forward(self, input: Tensor) -> Tensor:
        weight, bias = self.weight.to(input.dtype), self.bias.to(input.dtype)
        return functional.layer_norm(input, self.normalized_shape, weight, bias, self.eps)


class NsvfField(NetworkField):
    """Voxels, the cells of an occupancy, with embeddings, and a network of 545,284 parameters (Liu
    et al. 2020, Section 3.1, Appendix B, with the LayerNorm of the release). `precision` is that of
    the products, `backend` that of the kernels that render the field."""

    index: Tensor
    corners: Tensor
    vertices: Tensor

    def __init__(
        self,
        occupancy: Occupancy,
        precision: FieldPrecision,
        backend: str,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(backend)
        cells = occupancy.cells.cpu()
        coordinates = cells.nonzero()
        corners, vertices = corners_of(coordinates)
        index = torch.full(cells.shape, -1, dtype=torch.int32)
        index[cells] = torch.arange(len(coordinates), dtype=torch.int32)
        for name, value in (("index", index), ("corners", corners), ("vertices", vertices)):
            self.register_buffer(name, value, persistent=False)  # derived from the occupied cells
        first = torch.randn(len(vertices), EMBEDDING, generator=generator)
        self.embeddings = nn.Parameter(first * EMBEDDING**-0.5)

        def layer(inputs: int, outputs: int) -> nn.Module:
            dense = Dense(inputs, outputs, precision, generator)
            return nn.Sequential(dense, Norm(outputs), nn.ReLU(inplace=True))

        def layers(*widths: int) -> list[nn.Module]:
            return [layer(*pair) for pair in pairwise(widths)]

        encoded, direction = EMBEDDING * (1 + 2 * EMBEDDING_FREQUENCIES), 6 * DIRECTION_FREQUENCIES
        self.trunk = nn.Sequential(*layers(encoded, WIDTH, WIDTH, WIDTH))
        self.opacity = nn.Sequential(
            *layers(WIDTH, DENSITY_WIDTH), Dense(DENSITY_WIDTH, 1, precision, generator)
        )
        self.colour = nn.Sequential(
            *layers(WIDTH + direction, WIDTH, WIDTH, WIDTH, WIDTH),
            Dense(WIDTH, 3, precision, generator),
        )

    def density_together(self, positions: Tensor) -> TwoTensors:
        """As of any network; the density is 0 outside all voxels."""
        embedding, inside = self.embedding(positions)
        hidden = self.trunk(positional(embedding, EMBEDDING_FREQUENCIES))
        raw = self.opacity(hidden)[:, 0].to(embedding.dtype)
        return FREE_ENERGY * ACROSS * torch.where(inside, density_of(raw), 0), hidden

    def embedding(self, positions: Tensor) -> TwoTensors:
        """Trilinearly interpolated embeddings [S, 32], and whether there is a voxel [S]."""
        size = len(self.index)
        scaled = positions * size
        cell = scaled.long().clamp(0, size - 1)
        voxel = self.index[cell[:, 0], cell[:, 1], cell[:, 2]]
        weights = trilinear(scaled - cell)
        # Samples outside all voxels read some voxel: their density is set to 0.
        read = voxel.clamp(min=0)
        return corner_gather(
            self.embeddings, self.corners, read, weights, backend=self.backend
        ), voxel >= 0

    def encode_directions(self, directions: Tensor) -> Tensor:
        """Encoding [R, 24] of the unit directions; the release encodes their arc cosines."""
        unit = functional.normalize(directions, dim=-1)
        return positional(unit, DIRECTION_FREQUENCIES, identity=False, scale=1.0)

    def colours_together(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        """The network's output is linear, -1 black and 1 white, as released."""
        shown = self.colour(torch.cat((geometry, encoded.to(geometry)), dim=1))
        return (shown.to(encoded.dtype) + 1) / 2

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        density, colour = products(self.trunk, self.opacity), products(self.colour)
        probe.count("table_reads", CORNERS * samples)
        probe.count("products", density * samples + colour * shaded)

    def sizes(self) -> dict[str, int]:
        embeddings = self.embeddings.numel() * self.embeddings.element_size()
        return {"embeddings": embeddings, "network": super().sizes()["network"] - embeddings}
