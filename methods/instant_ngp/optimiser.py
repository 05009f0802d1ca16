"""Adam for a hash-grid field: dense for its networks, sparse for its table."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import torch
from torch import Tensor

from methods.instant_ngp.field import HashField
from methods.kernels.adam import AdamState, hash_adam_
from methods.kernels.encode import SampleGradients
from methods.training import checkpoint
from methods.training.optimiser import step_at


class FieldOptimiser:
    """Adam for the networks of `field`, and for its table one that skips untouched entries.

    Once this exists, the field collects the gradients of its samples in `gradients`, until `step`.
    """

    def __init__(self, field: HashField) -> None:
        self._field = field
        self._table = AdamState.like(field.table.detach())
        field.gradients = SampleGradients()

    @cached_property
    def _networks(self) -> torch.optim.Adam:
        # Created when needed: a process's first one imports torch's compiler, which takes seconds.
        parameters = list(self._field.layers.values())
        return torch.optim.Adam(parameters, betas=(0.9, 0.99), eps=1e-15, fused=True)

    def step(self, rate: float) -> None:
        """Update table and networks at learning rate `rate`."""
        step_at(self._networks, rate)
        field = self._field
        assert field.gradients is not None
        hash_adam_(
            field.table.detach(),
            field.gradients,
            field.grid,
            self._table,
            rate,
            packed=field.packed,
            backend=field.backend,
        )

    @property
    def table_moments(self) -> Tensor:
        """The sum of the table's moments, which is not finite where one of them is not."""
        return self._table.first + self._table.second

    def tensors(self) -> dict[str, Tensor]:
        """The state, for a checkpoint."""
        networks = checkpoint.optimiser_tensors(self._networks, "network.")
        return self._table.tensors("adam.") | networks

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Restore what `tensors` returned; gradients of a step that was not finished are lost."""
        self._field.gradients = SampleGradients()
        self._table = AdamState.of(tensors, "adam.", self._field.table.device)
        checkpoint.restore_optimiser(self._networks, tensors, "network.")
