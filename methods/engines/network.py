"""A network as an engine runs it.

A module of its own, so that trainings do not depend on any engine.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Built:
    """A network built by an engine: `run` is called like the network, and its next call may
    overwrite the returned pictures."""

    run: Callable[[Tensor], Tensor]
    size: int  # bytes of its weights in a file
    dtype: torch.dtype = torch.float32  # of input pictures that it need not convert
