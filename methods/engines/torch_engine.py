"""torch as an engine: the network as trained or in half precision, on a GPU with CUDA graphs.

In plain torch a network is dozens of operations, which the CPU launches one by one. A graph,
recorded once for each input size and then replayed, needs a single launch.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn

from bench.errors import Unavailable
from bench.types import Log
from methods.engines import Built, Engine, Folder, Samples
from methods.kernels import multiplies_bf16

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

WARM_UP = 3  # runs before recording, in which libraries choose algorithms and allocate workspace


class TorchEngine(Engine):
    """Runs the network itself; below fp32, products and convolutions are in half precision. A
    device without bfloat16 products multiplies numbers rounded to bfloat16 in float32; rows then
    say `bf16 in fp32`."""

    name = "torch"
    precisions = ("fp32", "bf16", "fp16")

    def check(self, device: torch.device) -> None:
        if self.precision == "fp16" and device.type == "cpu":
            raise Unavailable("precision=fp16: engine=torch has it on a GPU, on a CPU use bf16")

    def computed(self, device: torch.device) -> str:
        emulated = self.precision == "bf16" and not multiplies_bf16(device.type)
        return "bf16 in fp32" if emulated else super().computed(device)

    def build(self, network: nn.Module, samples: Samples, folder: Folder, log: Log) -> Built:
        dtype = DTYPES[self.precision]

        def run(picture: Tensor) -> Tensor:
            with _arithmetic(picture.device, dtype):
                return network(picture)

        size = sum(weight.numel() for weight in network.parameters()) * dtype.itemsize
        on_cpu = next(network.parameters()).device.type == "cpu"
        return Built(run if on_cpu else Replayed(run), size, dtype)


def _arithmetic(device: torch.device, dtype: torch.dtype) -> AbstractContextManager[object]:
    """Context for products in `dtype`. On a GPU it keeps float32 convolutions from using TF32."""
    if dtype != torch.float32:
        return torch.autocast(device.type, dtype)
    if device.type == "cuda":
        return torch.backends.cudnn.flags(enabled=True, allow_tf32=False)
    return nullcontext()


Replay = tuple[Callable[[], Any], Tensor]
"""A function that replays another, and the output tensor, which every replay overwrites."""


class Replayed:
    """Replays `run`; it is recorded for every input size when that size first occurs. The next
    call, of any size, overwrites the output, because all recordings share memory. `run` computes
    on a CUDA GPU, without waiting for it."""

    def __init__(self, run: Callable[[Tensor], Tensor]) -> None:
        self._run = run
        self._recordings: dict[torch.Size, tuple[Tensor, Replay]] = {}
        self._stream: torch.cuda.Stream | None = None  # on the first call's device
        self._pool: Any = None

    def __call__(self, picture: Tensor) -> Tensor:
        with torch.cuda.device_of(picture):
            if picture.shape not in self._recordings:
                copy = picture.clone()
                self._recordings[picture.shape] = copy, self.record(lambda: self._run(copy))
            held, (replay, output) = self._recordings[picture.shape]
            held.copy_(picture)
            replay()
        return output

    def record(self, run: Callable[[], Tensor]) -> Replay:
        """Record a graph. All share one memory pool, because no two are replayed at once."""
        if self._stream is None:
            self._stream, self._pool = torch.cuda.Stream(), torch.cuda.graph_pool_handle()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            for _ in range(WARM_UP):
                run()
        torch.cuda.current_stream().wait_stream(self._stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, stream=self._stream):
            output = run()
        return graph.replay, output
