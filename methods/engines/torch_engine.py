"""torch as an engine: the network as trained, or in half precision; on a GPU as CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

import torch
from torch import Tensor

from bench.errors import Unavailable
from bench.types import Log
from methods.engines import CALIBRATION, Built, Engine, Inputs, Network, resized, sizes_to_expect
from methods.engines.cuda_graphs import Replayed

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
        """See `Engine.samples`: on a GPU, enough to know the sizes that come; on a CPU none."""
        if _on_cpu(network):
            return 0
        return CALIBRATION if any(network.varying) else 1

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
            with _arithmetic(inputs[0].device, dtype):
                return network(*inputs)

        ready = run if _on_cpu(network) else _recorded(run, network, samples(), log)
        return Built(ready, sum(weight.numel() for weight in network.parameters()) * dtype.itemsize)


def _recorded(
    run: Callable[..., Inputs], network: Network, samples: Sequence[Inputs], log: Log
) -> Replayed:
    """`run` as CUDA graphs, recorded for the sizes to expect."""
    replayed = Replayed(run)
    sizes = sizes_to_expect(samples, network) or [1]  # or the one size that it has
    with torch.no_grad(), log.progress("recording CUDA graphs", len(sizes)) as progress:
        for size in sizes:
            replayed(*resized(samples[0], network, size))
            progress.advance()
    return replayed


def _arithmetic(device: torch.device, dtype: torch.dtype) -> AbstractContextManager[object]:
    """Products in `dtype`; on a GPU convolutions in float32 would else be computed in TF32."""
    if dtype != torch.float32:
        return torch.autocast(device.type, dtype)
    if device.type == "cuda":
        return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)
    return nullcontext()


def _on_cpu(network: Network) -> bool:
    return next(network.parameters()).device.type == "cpu"
