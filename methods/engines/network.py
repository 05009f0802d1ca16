"""The interface of a network that engines can run.

A module of its own, so that trainings do not depend on any engine.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn


class Network(nn.Module, ABC):
    """A network that engines can run: it maps tensors to a tuple of tensors.

    Attributes:
        varying: for each input, the axes whose size differs from frame to frame; all of them have
            the same size.
        quantum: this size is a multiple of `quantum` while frames are rendered.
        backend: backend of its kernels; engines convert it with "reference", which is plain torch.
    """

    varying: tuple[tuple[int, ...], ...]
    quantum = 1
    backend = "auto"

    @abstractmethod
    def products(self, *inputs: Tensor) -> int:
        """Number of multiplications by weights for `inputs`."""
