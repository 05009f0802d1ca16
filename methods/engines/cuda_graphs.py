"""CUDA graphs: a network's launches recorded once for inputs of one size, and played again.

In plain torch the lean network is some two hundred small operations, which the CPU launches one
after the other; a graph is launched at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from methods.engines import Inputs

WARM_UP = 3
"""Runs before the recording, in which libraries choose algorithms and take their workspace."""


class Replayed:
    """`run`, recorded for every size of its inputs that comes.

    What it returns is overwritten by the next call, of whatever size: all recordings share memory.

    Args:
        run: computes on a CUDA GPU, without asking it anything.
        record: makes of a function without arguments one that replays it, and what it returned,
            which every replay computes anew.
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
            return self._run(*inputs)  # nothing would be launched, and nothing is not recorded
        with torch.cuda.device_of(inputs[0]):
            recording = self._recording(inputs)
            for held, x in zip(recording.told, inputs, strict=True):
                held.copy_(x)
            recording.replay()
        return recording.said

    def _recording(self, inputs: Inputs) -> _Recording:
        sizes = tuple(x.shape for x in inputs)
        if sizes not in self._recordings:
            told = [x.clone() for x in inputs]
            self._recordings[sizes] = _Recording(told, *self._record(lambda: self._run(*told)))
        return self._recordings[sizes]


class _Recording(NamedTuple):
    told: Sequence[Tensor]
    replay: Callable[[], Any]
    said: Inputs


class _Recorder:
    """Records graphs, all with one pool of memory: no two of them are played at a time."""

    def __init__(self) -> None:
        self._stream: torch.cuda.Stream | None = None
        self._pool = torch.cuda.graph_pool_handle()

    def __call__(self, run: Callable[[], Inputs]) -> tuple[Callable[[], Any], Inputs]:
        stream = self._stream = self._stream or torch.cuda.Stream()  # of the device of the first
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                run()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=self._pool, stream=stream):
            said = run()
        return graph.replay, said
