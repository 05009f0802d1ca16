"""CUDA graphs: every size of inputs is recorded once, and replayed for what comes."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from methods.engines import Inputs
from methods.engines.cuda_graphs import Replayed
from methods.engines.torch_engine import TorchEngine
from tests.methods.engines.test_engines import TOLERANCE, cells, lean, unet


class Recorder:
    """Records on a CPU: to replay is to compute again, from the same inputs to the same outputs."""

    def __init__(self) -> None:
        self.recorded = 0

    def __call__(self, run: Callable[[], Inputs]) -> tuple[Callable[[], None], Inputs]:
        self.recorded += 1
        outputs = tuple(torch.full_like(x, torch.nan) for x in run())

        def replay() -> None:
            for held, x in zip(outputs, run(), strict=True):
                held.copy_(x)

        return replay, outputs


def test_a_replay_gives_the_outputs_of_the_network() -> None:
    network, _ = lean()
    recorder = Recorder()
    replayed = Replayed(network, recorder)
    for count, seed in ((64, 0), (100, 1), (64, 2), (100, 3)):
        given = cells(count, seed)
        for got, want in zip(replayed(*given), network(*given), strict=True):
            assert torch.equal(got, want)
    assert recorder.recorded == 2  # sizes


def test_its_inputs_stay_as_they_were() -> None:
    network, _ = lean()
    replayed = Replayed(network, Recorder())
    given = cells(64)
    replayed(*given)
    replayed(*cells(64, seed=1))
    assert all(torch.equal(x, held) for x, held in zip(given, cells(64), strict=True))


def test_of_nothing_nothing_is_recorded() -> None:
    network, _ = lean()
    recorder = Recorder()
    assert all(len(x) == 0 for x in Replayed(network, recorder)(*cells(0)))
    assert recorder.recorded == 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="for a machine with a GPU")
@pytest.mark.parametrize("precision", TorchEngine.precisions)
@pytest.mark.parametrize("make", [lean, unet])
def test_a_gpu_replays_the_outputs_of_the_network(precision, make, tmp_path, quiet_log) -> None:
    network, inputs = make()
    wanted = [network(*some) for some in inputs]
    there = network.to("cuda")
    seen = [tuple(x.cuda() for x in some) for some in inputs]
    built = TorchEngine(precision).build(there, lambda: seen, lambda: tmp_path, quiet_log)
    for some, want in zip(seen, wanted, strict=True):
        for got, outputs in zip(built.run(*some), want, strict=True):
            error = (got.cpu().float() - outputs).square().mean().sqrt()
            assert error < TOLERANCE.get(precision, 0.03) * outputs.square().mean().sqrt()
