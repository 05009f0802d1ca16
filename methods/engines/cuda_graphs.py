"""CUDA graphs: a network's kernel launches, recorded once per input size and then replayed.

In plain torch the lean network is some two hundred small operations, which the CPU launches one
by one. A graph needs a single launch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from methods.engines import Inputs

WARM_UP = 3
"""Runs before recording, in which libraries choose algorithms and allocate workspace."""


class Replayed:
    """Replays `run`; it is recorded for every input size when that size first occurs.

    The next call, of any size, overwrites the outputs, because all recordings share memory.

    Args:
        run: computes on a CUDA GPU, without waiting for it.
        record: turns a function without arguments into a function that replays it, and the output
            tensors, which every replay overwrites.
    """

    def __init__(
        self,
        run: Callable[..., Inputs],
        record: Callable[[Callable[[], Inputs]], tuple[Callable[[], Any], Inputs]] | None = None,
    ) -> None:
        self._run, self._record = run, record or _Recorder()
        self._recordings: dict[tuple[torch.Size, ...], _Recording] = {}

    def __call__(self, *inputs: Tensor) -> Inputs:
        if not all(x.numel() for x in inputs):
            return self._run(*inputs)  # launches nothing, and CUDA cannot record an empty graph
        with torch.cuda.device_of(inputs[0]):
            recording = self._recording(inputs)
            for held, x in zip(recording.inputs, inputs, strict=True):
                held.copy_(x)
            recording.replay()
        return recording.outputs

    def _recording(self, inputs: Inputs) -> _Recording:
        sizes = tuple(x.shape for x in inputs)
        if sizes not in self._recordings:
            held = tuple(x.clone() for x in inputs)
            self._recordings[sizes] = _Recording(held, *self._record(lambda: self._run(*held)))
        return self._recordings[sizes]


class _Recording(NamedTuple):
    inputs: Inputs
    replay: Callable[[], Any]
    outputs: Inputs


class _Recorder:
    """Records graphs that share one memory pool, because no two are replayed at the same time."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, run: Callable[[], Inputs]) -> tuple[Callable[[], Any], Inputs]:
        stream = self._stream = self._stream or torch.cuda.Stream()  # on the first call's device
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                run()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, stream=stream):
            outputs = run()
        return graph.replay, outputs
