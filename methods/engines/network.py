"""The interface of a network that engines can run.

A module of its own, so that trainings do not depend on any engine.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

Inputs = tuple[Tensor, ...]


@dataclass(frozen=True)
class Built:
    """A network built by an engine: `run` is called like the network, and its next call may
    overwrite the returned tensors."""

    run: Callable[..., Inputs]
    size: int  # bytes of its weights in a file
    dtype: torch.dtype = torch.float32  # of input pictures that it need not convert


class Network(nn.Module, ABC):
    """A network that engines can run: it maps pictures [B, C, H, W] to a tuple of pictures. Of an
    input, only C is always the same."""

    @abstractmethod
    def products(self, *inputs: Tensor) -> int:
        """Number of multiplications by weights for `inputs`."""
