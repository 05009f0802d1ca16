"""The interface of a radiance field to its renderers, and how batches of samples are evaluated."""

from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import functional

from bench.types import Probe, TwoTensors

BATCH_QUANTUM = 1 << 11  # samples are handed to a field in multiples of this

CHUNK_SAMPLES = 1 << 18
"""Samples that are evaluated together if no gradient is needed: bounds the memory."""

CACHED_SAMPLES = 1 << 15
"""Samples that go through all layers together on a CPU: with the 128 bytes that each has between
two layers of Instant-NGP, two cores with 2 MB of second-level cache keep them there."""

ROUND_SAMPLES = 6
"""Samples of a ray that a field evaluates together where rays end early, if a sample costs little.
With more, some are evaluated in vain behind the end of a ray; with fewer, there are more rounds."""

LOG_DENSITY_CLAMP = 15.0
"""The gradient of exp is taken at a log density clamped to +- this (as torch-ngp and ngp_pl do)."""


class Field(Protocol):
    """A density and K features of a position and a view direction (SteerNeRF Eq. 4)."""

    channels: int  # K; the first three features are RGB
    backend: str  # of the kernels that render it
    round_samples: int  # of a ray, that are best evaluated together where rays end early

    @property
    def device(self) -> torch.device:
        """The device of its parameters."""

    def density(self, positions: Tensor) -> TwoTensors:
        """Density [S] at `positions` [S, 3], and the geometry [S, G] that `features` needs."""

    def encode_directions(self, directions: Tensor) -> Tensor:
        """Encoding [R, D] of ray `directions` [R, 3] of any length."""

    def features(self, geometry: Tensor, encoded: Tensor) -> Tensor:
        """Features [S, K] of samples with `geometry` [S, G] and encoded directions [S, D]."""

    def count(self, probe: Probe, samples: int, shaded: int) -> None:
        """Count the work of `samples` densities and `shaded` features."""


@runtime_checkable
class Encoder(Field, Protocol):
    """A field whose encoding of a position takes longer to compute than to keep and fetch."""

    def encode(self, positions: Tensor) -> Tensor:
        """Encoding [S, E] of `positions` [S, 3]."""

    def density(self, positions: Tensor, encoded: Tensor | None = None) -> TwoTensors:
        """As of any field; `encoded` is what `encode` returned for `positions`, which may lack a
        gradient; None: it is computed here."""


def query(
    field: Field, positions: Tensor, ray: Tensor, directions: Tensor, encoded: Tensor | None = None
) -> TwoTensors:
    """Density [S] and features [S, K] at `positions` [S, 3] on rays `ray` [S], whose encoded
    directions are `directions` [R, D]; evaluated as a padded batch. `encoded` is the encoding
    [S, E] of the positions by `field`, an `Encoder`, if it is known."""
    if encoded is None:
        sigma, geometry = field.density(pad(positions))
    else:
        assert isinstance(field, Encoder)
        sigma, geometry = field.density(pad(positions), pad(encoded))
    values = field.features(geometry, directions.index_select(0, pad(ray)))
    if len(sigma) == len(positions):  # a gradient would be copied for a part
        return sigma, values
    return sigma[: len(positions)], values[: len(positions)]


def pad(samples: Tensor) -> Tensor:
    """Pad [S, ...] on a CPU with zeros to a multiple of `BATCH_QUANTUM`. oneDNN prepares code for
    every new matrix size, which takes longer than the product itself, so a field should see only a
    few round batch sizes."""
    padding = -len(samples) % BATCH_QUANTUM
    if not padding or samples.device.type != "cpu":
        return samples
    return functional.pad(samples, (0, 0) * (samples.dim() - 1) + (0, padding))
