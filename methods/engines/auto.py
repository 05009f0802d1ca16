"""Chooses the engine and precision that compute a 2D renderer fastest on this machine."""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import torch

from bench.errors import SteerbenchError, Unavailable, unexpected
from bench.provenance import computed_by
from bench.types import Log
from methods.engines import Engine, keep
from methods.engines.openvino_engine import OpenVino
from methods.engines.tensorrt_engine import TensorRt
from methods.engines.torch_engine import TorchEngine

KINDS: tuple[type[Engine], ...] = (TorchEngine, OpenVino, TensorRt)


class EngineFigures(NamedTuple):
    """What frames have and take with an engine."""

    psnr: float  # dB
    ms: float  # of the 2D renderer


Measure = Callable[[Sequence[Engine]], Sequence[EngineFigures]]
"""Renders the same frames with several engines, in turns."""


class Auto:
    """The fastest engine and precision here whose pictures lose at most `loss` dB of PSNR against
    those of torch in fp32. It is found once for a trained network, and remembered."""

    name, precisions = "auto", ()  # no precision is asked for by name

    def __init__(self, loss: float) -> None:
        self.loss = loss

    def check(self, device: torch.device) -> None:
        """As of an engine; torch in fp32 can always be chosen."""

    def computed(self, device: torch.device) -> str:
        return self.name

    def _candidates(self, device: torch.device) -> Iterator[Engine]:
        """All engines and precisions that can be used on `device`; torch in fp32 first."""
        for kind in KINDS:
            for precision in kind.precisions:
                with suppress(Unavailable):
                    engine = kind(precision)
                    engine.check(device)
                    if not engine.computed(device).endswith("in fp32"):  # emulated: only slower
                        yield engine

    def key(self, device: torch.device) -> dict[str, object]:
        """Everything that the choice on `device` depends on, besides the network."""
        keys = [engine.key() for engine in self._candidates(device)]
        return {"candidates": keys, **computed_by(Auto)}

    def chosen(self, device: torch.device, measure: Measure, folder: Path, log: Log) -> Engine:
        """The engine to use on `device`: as noted in `folder`, or as `measure` shows; raise
        SteerbenchError if the pictures of torch in fp32 are not finite."""
        engines, path = list(self._candidates(device)), folder / "engines.json"

        def write(new: Path) -> None:
            measured = measure(engines)
            if not measured[0].psnr > -math.inf:
                raise SteerbenchError(
                    "engine=auto: expected finite pictures to compare engines with, the trained "
                    f"network renders others with {engines[0]} (PSNR {measured[0].psnr}): train "
                    "it again, with a smaller learning rate or another seed"
                )
            new.write_text(json.dumps(measured))

        keep(path, write, log)
        try:
            found = [EngineFigures(*figures) for figures in json.loads(path.read_text())]
        except (ValueError, TypeError) as error:
            got = f"{error}; remove it, and they are measured again"
            raise unexpected(path, "a list with the figures of engines", got) from error
        for engine, figures in zip(engines, found, strict=True):
            log.info(f"engine {engine}: {figures.ms:.1f} ms, {figures.psnr:.2f} dB")
        good = [place for place, it in enumerate(found) if it.psnr >= found[0].psnr - self.loss]
        best = engines[min(good, key=lambda place: found[place].ms)]
        log.info(f"engine chosen: {best}")
        return best
