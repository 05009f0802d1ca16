"""A network as engines run it. Apart from them: what is trained does not depend on any engine."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn


class Network(nn.Module, ABC):
    """A network that engines can run: tensors to a tuple of tensors.

    Attributes:
        varying: of each input, the axes whose size, the same for all of them, differs from frame to
            frame.
        quantum: that size is a multiple of this while frames are rendered.
        backend: of its kernels; engines read "reference", which is plain torch.
    """

    varying: tuple[tuple[int, ...], ...]
    quantum = 1
    backend = "auto"

    @abstractmethod
    def products(self, *inputs: Tensor) -> int:
        """Multiplications by weights that `inputs` take."""
