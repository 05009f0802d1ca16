"""torch as an engine: the network as trained or in half precision, on a GPU with CUDA graphs."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from bench.errors import Unavailable
from bench.types import Log
from methods.engines import (
    Built,
    Engine,
    Folder,
    Inputs,
    Network,
    Samples,
    resized,
    sizes_to_expect,
)
from methods.engines.cuda_graphs import Replayed
from methods.kernels import multiplies_bf16

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}


class TorchEngine(Engine):
    """Runs the network itself; below fp32, products and convolutions are in half precision.

    A device without bfloat16 products multiplies numbers rounded to bfloat16 in float32; rows then
    say `bf16 in fp32`.
    """

    name = "torch"
    precisions = ("fp32", "bf16", "fp16")

    def check(self, device: torch.device) -> None:
        """Raise `Unavailable` for fp16 on a CPU."""
        if self.precision == "fp16" and device.type == "cpu":
            raise Unavailable("precision=fp16: engine=torch has it on a GPU, on a CPU use bf16")

    def computed(self, device: torch.device) -> str:
        """The precision of products: bf16 may be emulated on `device`."""
        emulated = self.precision == "bf16" and not multiplies_bf16(device.type)
        return "bf16 in fp32" if emulated else super().computed(device)

    def samples(self, network: Network) -> int:
        """Frames whose inputs `build` needs: none on a CPU, which runs the network itself."""
        return 0 if _on_cpu(network) else super().samples(network)

    def build(self, network: Network, samples: Samples, folder: Folder, log: Log) -> Built:
        """Make `network` compute at this precision; on a GPU, record CUDA graphs of it."""
        dtype = DTYPES[self.precision]

        def run(*inputs: Tensor) -> Inputs:
            with _arithmetic(inputs[0].device, dtype):
                return network(*inputs)

        size = sum(weight.numel() for weight in network.parameters()) * dtype.itemsize
        return Built(run if _on_cpu(network) else _recorded(run, network, samples, log), size)


def _recorded(run: Callable[..., Inputs], network: Network, samples: Samples, log: Log) -> Replayed:
    """`run` as CUDA graphs, recorded beforehand for the expected sizes."""
    replayed, seen = Replayed(run), samples()
    expected = [resized(seen[0], size) for size in sizes_to_expect(seen, network)] or seen[:1]
    with torch.no_grad(), log.progress("recording CUDA graphs", len(expected)) as progress:
        for inputs in expected:
            replayed(*inputs)
            progress.advance()
    return replayed


def _arithmetic(device: torch.device, dtype: torch.dtype) -> AbstractContextManager[object]:
    """Context for products in `dtype`. On a GPU it keeps float32 convolutions from using TF32."""
    if dtype != torch.float32:
        return torch.autocast(device.type, dtype)
    if device.type == "cuda":
        return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)
    return nullcontext()


def _on_cpu(network: Network) -> bool:
    return next(network.parameters()).device.type == "cpu"
