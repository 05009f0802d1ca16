"""Engines: what computes the network of a 2D renderer once it is trained, and at which precision.

An engine makes of a network, and of inputs that it saw on real frames, a function of the same
tensors. Kernels, reprojection and the field stay what they are.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from bench.errors import Unavailable
from bench.sources import digest, libraries
from bench.types import Log

Precision = Literal["fp32", "bf16", "fp16", "int8"]

Inputs = tuple[Tensor, ...]

CALIBRATION = 16
"""Frames whose inputs tell the range of every number that is rounded to 8 bits, and the sizes of
varying axes that are to be expected."""

SIZES = "steerbench_sizes"
"""Where a stored model says for which sizes of varying axes it is made ready beforehand."""


class Network(nn.Module, ABC):
    """A network as engines can run it: tensors to a tuple of tensors.

    Attributes:
        varying: of each input, the axes whose size, the same for all of them, differs from frame to
            frame.
        quantum: that size is a multiple of this while frames are rendered.
        backend: of its kernels; engines read "reference", which is plain torch.
    """

    varying: tuple[tuple[int, ...], ...]
    quantum = 1
    backend = "auto"

    @abstractmethod
    def products(self, *inputs: Tensor) -> int:
        """Multiplications by weights that `inputs` take."""


@dataclass(frozen=True)
class Built:
    """A network as an engine runs it.

    Attributes:
        run: as the network. What it returns may be overwritten by the next call.
        size: bytes of its weights, as a file needs them at its precision.
    """

    run: Callable[..., Inputs]
    size: int


class Engine(ABC):
    """Builds networks at one `precision`.

    Attributes:
        name: as it stands in rows.
        precisions: that it has.
        libraries: distributions that it loads when it is made.

    Raises:
        Unavailable: the engine does not have this precision, or cannot be used here.
    """

    name: ClassVar[str]
    precisions: ClassVar[tuple[Precision, ...]]
    libraries: ClassVar[tuple[str, ...]] = ()

    def __init__(self, precision: Precision = "fp32") -> None:
        if precision not in self.precisions:
            raise Unavailable(
                f"precision={precision}: expected one of {', '.join(self.precisions)}, which "
                f"engine={self.name} has"
            )
        self.precision = precision

    def check(self, device: torch.device) -> None:
        """Raise `Unavailable` unless the engine computes at this precision on `device`."""
        if device.type != "cpu":
            raise Unavailable(
                f"engine={self.name} computes on the CPU, this is device={device}: use "
                "engine=torch or device=cpu"
            )

    def samples(self, network: Network) -> int:
        """Frames whose inputs `build` wants to see."""
        return CALIBRATION if self.precision == "int8" else 1

    def key(self) -> dict[str, object]:
        """Everything that what is built depends on, beside the network and its inputs."""
        kind = type(self)
        return {
            "engine": self.name,
            "precision": self.precision,
            "code": digest(kind),
            "libraries": libraries(kind),
        }

    @abstractmethod
    def build(
        self,
        network: Network,
        samples: Callable[[], Sequence[Inputs]],
        folder: Callable[[], Path],
        log: Log,
    ) -> Built:
        """Make `network` run, or load what the same build left behind.

        Args:
            samples: called if they are needed: the inputs of `self.samples(network)` frames.
            folder: called if something is kept there: of this network and engine alone.
        """


def readable(network: Network) -> Network:
    """A copy of `network` in plain torch, which the converters of engines can follow."""
    copy = deepcopy(network)
    copy.backend = "reference"
    return copy


def sizes_to_expect(samples: Sequence[Inputs], network: Network) -> list[int]:
    """The sizes of varying axes that were seen, those between, and one beyond on either side."""
    seen = {
        x.shape[axis]
        for inputs in samples
        for x, axes in zip(inputs, network.varying, strict=True)
        for axis in axes
    }
    if not seen:
        return []
    step = network.quantum
    least, most = max(min(seen) // step - 1, 1), -(-max(seen) // step) + 1
    return sorted({*seen, *range(least * step, most * step + 1, step)})


def resized(sample: Inputs, network: Network, size: int) -> Inputs:
    """Zeros like `sample`, whose varying axes are of `size`."""
    shapes = (
        [size if axis in axes else length for axis, length in enumerate(x.shape)]
        for x, axes in zip(sample, network.varying, strict=True)
    )
    return tuple(x.new_zeros(shape) for x, shape in zip(sample, shapes, strict=True))


def required(engine: str, library: str, extra: str) -> ModuleType:
    """Import a library that `engine` stands on.

    Raises:
        Unavailable: it is not installed.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise Unavailable(
            f"engine={engine} cannot be used here ({error}): "
            f'pip install -c constraints.txt -e ".[{extra}]"'
        ) from error
