"""torch as an engine: the network as it was trained, or in half precision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from bench.errors import Unavailable
from bench.types import Log
from methods.engines import Built, Engine, Inputs
from methods.renderer2d import Network

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


class TorchEngine(Engine):
    """The network itself; below fp32, its products and convolutions in half precision."""

    name = "torch"
    precisions = ("fp32", "bf16", "fp16")

    def check(self, device: torch.device) -> None:
        """See `Engine.check`."""
        if self.precision == "fp16" and device.type == "cpu":
            raise Unavailable("precision=fp16: engine=torch has it on a GPU, on a CPU use bf16")

    def samples(self, network: Network) -> int:
        """None: nothing is prepared."""
        return 0

    def key(self) -> dict[str, object]:
        """See `Engine.key`."""
        return {"engine": self.name, "precision": self.precision}

    def build(
        self,
        network: Network,
        samples: Callable[[], Sequence[Inputs]],
        folder: Callable[[], Path],
        log: Log,
    ) -> Built:
        """See `Engine.build`."""
        dtype = DTYPES[self.precision]

        def run(*inputs: Tensor) -> Inputs:
            half = dtype != torch.float32
            with torch.autocast(inputs[0].device.type, dtype, enabled=half):
                return network(*inputs)

        return Built(run, sum(weight.numel() for weight in network.parameters()) * dtype.itemsize)
