"""Engines: they compute the trained network of a 2D renderer, each at its precisions.

An engine turns a network, and inputs of it from real frames, into a function of the same tensors.
Kernels, reprojection and the field do not pass through an engine.
"""

from __future__ import annotations

import importlib
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Literal

import torch
from torch import Tensor

from bench.errors import Unavailable, explained, install_command
from bench.sharing import missing
from bench.sources import digest, libraries
from bench.types import Log
from methods.engines.network import Network as Network

Precision = Literal["fp32", "bf16", "fp16", "int8"]

Calibration = Literal["frames", "none"]
"""What gives the ranges of 8-bit activations: real frames, or nothing (`fixed_ranges`)."""

Inputs = tuple[Tensor, ...]

Samples = Callable[[], Sequence[Inputs]]
"""Gives the inputs of a network in several frames. Called only if something is built from them."""

Folder = Callable[[], Path]
"""Gives a folder of one network and engine alone. Called only if something is kept there."""

CALIBRATION = 16
"""Frames whose inputs give the range of every number that is rounded to 8 bits, and the sizes of
varying axes to expect."""

SIZES = "steerbench_sizes"
"""Key, in a stored model, of the sizes of varying axes to prepare."""


@dataclass(frozen=True)
class Built:
    """A network as an engine runs it.

    Attributes:
        run: as the network. What it returns may be overwritten by the next call.
        size: bytes of its weights in a file at its precision.
    """

    run: Callable[..., Inputs]
    size: int


class Engine(ABC):
    """Builds networks at one `precision`.

    Args:
        precision: one of `precisions`.
        calibration: of int8; no other precision depends on it.

    Attributes:
        uncalibrated: whether it is int8 without calibration.
        name: as it stands in rows.
        precisions: those it has.
        libraries: distributions that it loads when it is made.
        prepares_sizes: whether it prepares, before a frame is rendered, for the sizes of varying
            axes that it has seen.

    Raises:
        Unavailable: the engine does not have this precision, or cannot be used here.
    """

    name: ClassVar[str]
    precisions: ClassVar[tuple[Precision, ...]]
    libraries: ClassVar[tuple[str, ...]] = ()
    prepares_sizes: ClassVar[bool] = True

    def __init__(self, precision: Precision = "fp32", calibration: Calibration = "frames") -> None:
        if precision not in self.precisions:
            raise Unavailable(
                f"precision={precision}: expected one of {', '.join(self.precisions)}, which "
                f"engine={self.name} has"
            )
        self.precision = precision
        self.uncalibrated = precision == "int8" and calibration == "none"

    def check(self, device: torch.device) -> None:
        """Raise `Unavailable` unless the engine computes at this precision on `device`."""
        if device.type != "cpu":
            raise Unavailable(
                f"engine={self.name} computes on the CPU, this is device={device}: use "
                "engine=torch or device=cpu"
            )

    def computed(self, device: torch.device) -> str:
        """The precision that products really have on `device`, as it stands in rows.

        With int8 a second part, after `+`, is the precision of everything that is not quantised.
        """
        if self.precision != "int8":
            return self.precision
        return "int8 uncalibrated+fp32" if self.uncalibrated else "int8+fp32"

    def samples(self, network: Network) -> int:
        """Number of frames whose inputs `build` needs. Of one frame it reads the shapes alone."""
        calibrated = self.precision == "int8" and not self.uncalibrated
        several = calibrated or (self.prepares_sizes and any(network.varying))
        return CALIBRATION if several else 1

    def key(self) -> dict[str, object]:
        """Everything that the built network depends on, beside the network and its inputs."""
        kind = type(self)
        return {
            "engine": self.name,
            "precision": self.precision,
            "uncalibrated": self.uncalibrated,
            "code": digest(kind),
            "libraries": libraries(kind),
        }

    @abstractmethod
    def build(self, network: Network, samples: Samples, folder: Folder, log: Log) -> Built:
        """Make `network` run, or load what an earlier build of the same kept.

        Args:
            network: on the device where it will run.
            samples: of `self.samples(network)` frames.
            folder: for what is built.
            log: for progress, and where a built network was found.
        """


def keep(path: Path, write: Callable[[Path], None], log: Log) -> None:
    """Have `write` make the file `path`, unless it exists: whole or not at all, by one process.

    `write` gets a path of the same name in a temporary folder. Of what it leaves there, the files
    that differ from `path` in their suffix are kept, too.

    Raises:
        SteerbenchError: the folder of `path` cannot be written to.
    """
    with missing(path, log) as to_build:
        if not to_build:
            log.info(f"built network found: {path}")
            return
        with explained(path.parent), tempfile.TemporaryDirectory(dir=path.parent) as place:
            write(Path(place, path.name))
            parts = Path(place).glob(f"{path.stem}.*")
            for part in sorted(parts, key=lambda part: part.name == path.name):  # `path` comes last
                part.replace(path.parent / part.name)


def readable(network: Network) -> Network:
    """A copy of `network` in plain torch, which the converters of engines can follow."""
    copy = deepcopy(network)
    copy.backend = "reference"
    return copy


def sizes_to_expect(samples: Sequence[Inputs], network: Network) -> list[int]:
    """The sizes of varying axes in `samples`, those between, and one quantum beyond either end."""
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
    """Zeros like `sample`, with varying axes of `size`."""
    shapes = (
        [size if axis in axes else length for axis, length in enumerate(x.shape)]
        for x, axes in zip(sample, network.varying, strict=True)
    )
    return tuple(x.new_zeros(shape) for x, shape in zip(sample, shapes, strict=True))


def required(engine: str, library: str, extra: str) -> ModuleType:
    """Import a library that `engine` needs.

    Raises:
        Unavailable: it is not installed.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise Unavailable(
            f"engine={engine} cannot be used here ({error}): {install_command(extra)}"
        ) from error
