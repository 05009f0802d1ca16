"""A hash-grid field: position and view direction to density and K features (SteerNeRF Eq. 4)."""

import math
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from bench.types import Probe, TwoTensors
from methods.kernels import multiplies_bf16
from methods.kernels.encode import HashGrid, SampleGradients, collect, encode, pack
from methods.kernels.mlp import mlp
from methods.kernels.shade import harmonics
from methods.kernels.spherical import CHANNELS as DIRECTION_CHANNELS
from methods.kernels.types import cat
from methods.rendering.field import (
    BATCH_QUANTUM,
    CACHED_SAMPLES,
    CHUNK_SAMPLES,
    LOG_DENSITY_CLAMP,
    ROUND_SAMPLES,
)

FieldPrecision = Literal["bf16", "fp32"]

HIDDEN_CHANNELS = 64  # width of every layer between input and output

GEOMETRY_CHANNELS = 16
"""Outputs of the density network. The first is the log density; all feed the feature network."""


class HashField(nn.Module):
    """Hash-grid encoding, a density network (32-64-16) and a feature network (32-64-64-K).

    No biases, ReLU between layers, exp for density, sigmoid for features (Instant-NGP, Section 5.4;
    ngp_pl `networks.py`).

    With precision "bf16" the table is read as packed bfloat16, and matrix products use bfloat16
    weights and float32 accumulation; parameters, gradients of the table and outputs stay float32.
    Activations stay float32 as well if the device has no bfloat16 products.
    """

    round_samples = ROUND_SAMPLES

    def __init__(
        self,
        grid: HashGrid,
        channels: int = 3,
        *,
        precision: FieldPrecision = "bf16",
        backend: str = "auto",
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.grid, self.channels, self.precision, self.backend = grid, channels, precision, backend
        table = torch.empty(grid.entries, grid.features).uniform_(-1e-4, 1e-4, generator=generator)
        self.table = nn.Parameter(table)
        sizes = {
            "density_in": (HIDDEN_CHANNELS, grid.channels),
            "density_out": (GEOMETRY_CHANNELS, HIDDEN_CHANNELS),
            "feature_in": (HIDDEN_CHANNELS, DIRECTION_CHANNELS + GEOMETRY_CHANNELS),
            "feature_mid": (HIDDEN_CHANNELS, HIDDEN_CHANNELS),
            "feature_out": (channels, HIDDEN_CHANNELS),
        }
        layers = {name: _xavier_uniform(*size, generator) for name, size in sizes.items()}
        self.layers = nn.ParameterDict(layers)
        packed = pack(table) if precision == "bf16" else None
        self.packed: Tensor | None
        self.register_buffer("packed", packed, persistent=False)
        self.gradients: SampleGradients | None = None  # set by a training of the table

    def repack(self) -> None:
        """Update the packed copy after the table was changed from outside."""
        if self.packed is not None:
            self.packed.copy_(pack(self.table))

    def widen(self, channels: int, generator: torch.Generator) -> None:
        """Append features up to `channels`, with random initial weights from `generator`."""
        old = self.layers["feature_out"].detach()
        more = _xavier_uniform(channels, HIDDEN_CHANNELS, generator).detach()[len(old) :]
        self.channels = channels
        self.layers["feature_out"] = nn.Parameter(torch.cat((old, more.to(old))))

    @property
    def device(self) -> torch.device:
        return self.table.device

    def encode_directions(self, directions: Tensor) -> Tensor:
        """Spherical harmonics [R, 16] of ray `directions` [R, 3] of any length."""
        unit = functional.normalize(directions, dim=-1)
        return harmonics(unit, backend=self.backend).to(self._compute_dtype)

    def encode(self, positions: Tensor) -> Tensor:
        """Features [S, channels] of the table at `positions` [S, 3]."""
        return encode(
            positions,
            self.table,
            self.grid,
            packed=self.packed,
            gradients=self.gradients,
            backend=self.backend,
        )

    def density(self, positions: Tensor, encoded: Tensor | None = None) -> TwoTensors:
        """As of any `Encoder`: density [S] float32 and geometry channels [S, 16]."""
        weights = self._weights("density_in", "density_out")
        size = self._part(positions)
        parts = positions.split(size)
        known = [None] * len(parts) if encoded is None else encoded.split(size)
        sigma, geometry = [], []
        for part, code in zip(parts, known, strict=True):
            features = self.encode(part) if code is None else self._learning(code, part)
            outputs = mlp([features.to(self._compute_dtype)], weights, backend=self.backend)
            geometry.append(outputs)
            sigma.append(_ClampedExp.apply(outputs[:, 0].to(self.table.dtype)))
        return cat(sigma), cat(geometry)

    def _learning(self, known: Tensor, positions: Tensor) -> Tensor:
        """The encoding that is `known`, with a gradient if one is asked for."""
        if known.requires_grad or not torch.is_grad_enabled():
            return known
        if self.gradients is None:  # the gradient goes to the table, through the encoding itself
            return self.encode(positions)
        return collect(known, positions, self.gradients)

    def features(self, geometry: Tensor, directions: Tensor) -> Tensor:
        """Features [S, K] float32 of samples with encoded view `directions` [S, 16]."""
        weights = self._weights("feature_in", "feature_mid", "feature_out")
        size = self._part(geometry)
        parts = []
        for pair in zip(directions.split(size), geometry.split(size), strict=True):
            raw = mlp(list(pair), weights, backend=self.backend)
            parts.append(raw.to(self.table.dtype).sigmoid())
        return cat(parts)

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        density = self.layers["density_in"].numel() + self.layers["density_out"].numel()
        features = sum(self.layers[f"feature_{name}"].numel() for name in ("in", "mid", "out"))
        probe.count("table_reads", 8 * self.grid.levels * samples)
        probe.count("products", density * samples + features * shaded)

    def sizes(self) -> dict[str, int]:
        """Bytes of table and networks at the precision at which they are read."""
        width = 2 if self.precision == "bf16" else 4
        networks = sum(layer.numel() for layer in self.layers.values())
        return {"hash_table": self.table.numel() * width, "field_networks": networks * width}

    def _part(self, samples: Tensor) -> int:
        """How many of the `samples` go through all layers before the next ones do: parts of one
        size, because a small one takes more time than its share."""
        most = CACHED_SAMPLES if self.device.type == "cpu" else CHUNK_SAMPLES
        parts = max(1, round(len(samples) / most))
        return max(1, -(-len(samples) // (parts * BATCH_QUANTUM)) * BATCH_QUANTUM)

    @property
    def _compute_dtype(self) -> torch.dtype:
        half = self.precision == "bf16" and multiplies_bf16(self.device.type)
        return torch.bfloat16 if half else self.table.dtype

    def _weights(self, *names: str) -> list[Tensor]:
        """The weights of layers as they are multiplied; with "bf16" they are always rounded."""
        layers = [self.layers[name] for name in names]
        if self.precision == "bf16":
            layers = [layer.to(torch.bfloat16) for layer in layers]
        return [layer.to(self._compute_dtype) for layer in layers]


def _xavier_uniform(outputs: int, inputs: int, generator: torch.Generator | None) -> nn.Parameter:
    bound = math.sqrt(6 / (outputs + inputs))
    weights = torch.empty(outputs, inputs).uniform_(-bound, bound, generator=generator)
    return nn.Parameter(weights)


class _ClampedExp(torch.autograd.Function):
    """exp, whose gradient neither vanishes nor overflows far from 0."""

    @staticmethod
    def forward(ctx, log_density):
        ctx.save_for_backward(log_density)
        return log_density.exp()

    @staticmethod
    def backward(ctx, grad):
        (log_density,) = ctx.saved_tensors
        return grad * log_density.clamp(-LOG_DENSITY_CLAMP, LOG_DENSITY_CLAMP).exp()
