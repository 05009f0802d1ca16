"""Engines run the trained network of a 2D renderer, each at the precisions that it supports.

An engine turns a network, which maps pictures [B, C, H, W] to pictures, and sample inputs from real
frames into a function that does the same. Of a picture, only C is always the same. Kernels,
reprojection and the field do not use an engine.
"""

import importlib
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from bench.errors import Unavailable, explained, install_command
from bench.provenance import digest, libraries
from bench.sharing import check_sums, missing, write_sums
from bench.types import Log
from methods.engines.network import Built as Built

Precision = Literal["fp32", "bf16", "fp16", "int8"]

Calibration = Literal["frames", "none"]
"""Source of the ranges of 8-bit activations: real frames, or none: see `largest`."""

Samples = Callable[[], Sequence[Tensor]]
"""Returns the inputs of a network in several frames. Called only if a build needs them."""

Folder = Callable[[], Path]
"""Returns a folder reserved for one network and engine. Called only if a build stores something."""


CALIBRATION = 16  # frames whose inputs determine the ranges of all 8-bit numbers


class Engine(ABC):
    """Builds networks at one of its `precisions`; only int8 depends on `calibration`. The
    constructor raises `Unavailable` if the engine does not have the precision, or cannot be used
    here."""

    name: ClassVar[str]  # as shown in rows
    precisions: ClassVar[tuple[Precision, ...]]
    libraries: ClassVar[Sequence[str]] = ()  # distributions that the constructor loads

    def __init__(self, precision: Precision = "fp32", calibration: Calibration = "frames") -> None:
        if precision not in self.precisions:
            raise Unavailable(
                f"precision={precision}: expected one of {', '.join(self.precisions)}, which "
                f"engine={self.name} has"
            )
        self.precision = precision
        self.uncalibrated = precision == "int8" and calibration == "none"

    def import_library(self, library: str) -> ModuleType:
        """Import a library of the engine; raise `Unavailable` if it is not installed."""
        try:
            return importlib.import_module(library)
        except ImportError as error:
            raise Unavailable(
                f"engine={self.name} cannot be used here ({error}): {install_command(self.name)}"
            ) from error

    def check(self, device: torch.device) -> None:
        """Raise `Unavailable` unless the engine can compute at this precision on `device`."""
        if device.type != "cpu":
            raise Unavailable(
                f"engine={self.name} computes on the CPU, this is device={device}: use "
                "engine=torch or device=cpu"
            )

    def computed(self, device: torch.device) -> str:
        """The precision that products really have on `device`, as shown in rows. For int8, a second
        part after `+` is the precision of everything that is not quantised."""
        if self.precision != "int8":
            return self.precision
        return "int8 uncalibrated+fp32" if self.uncalibrated else "int8+fp32"

    @property
    def samples(self) -> int:
        """Number of frames whose inputs `build` needs. If it is 1, only their shapes are read."""
        return CALIBRATION if self.precision == "int8" and not self.uncalibrated else 1

    def key(self) -> Mapping[str, object]:
        """Everything that the built network depends on, besides the network and its inputs."""
        kind = type(self)
        return {
            "engine": self.name,
            "precision": self.precision,
            "uncalibrated": self.uncalibrated,
            "code": digest(kind),
            "libraries": libraries(kind),
        }

    @abstractmethod
    def build(self, network: nn.Module, samples: Samples, folder: Folder, log: Log) -> Built:
        """Build `network`, which is on the device where it will run, or load an earlier build of it
        from `folder`. `samples` are inputs of `self.samples` frames; others may differ in size."""


def keep(path: Path, write: Callable[[Path], None], log: Log) -> None:
    """Let `write` create the file `path` unless it exists: atomically, and in one process only.

    `write` gets a path with the same name in a temporary folder. Files that it leaves there which
    differ from `path` only in their suffix are kept, too. A folder that cannot be written to, or
    files that are not as they were written, raise `SteerbenchError`.
    """
    with missing(path, log) as to_build:
        if not to_build:
            check_sums(path.parent, sums=f"{path.stem}.sha256")
            log.info(f"found: {path}")
            return
        with explained(path.parent), tempfile.TemporaryDirectory(dir=path.parent) as place:
            write(Path(place, path.name))
            write_sums(Path(place), f"{path.stem}.*", f"{path.stem}.sha256")
            parts = Path(place).glob(f"{path.stem}.*")
            for part in sorted(parts, key=lambda part: part.name == path.name):  # `path` comes last
                part.replace(path.parent / part.name)


def largest(maker: str | None) -> float:
    """The largest number in the range of an 8-bit activation without calibration, as of
    `trtexec --int8` without `--calib`; `maker` is the type of the operator that computes the
    tensor, None for an input of the network.

    `setTensorDynamicRange` in samples/common/sampleEngines.cpp of the repository NVIDIA/TensorRT
    (at 147005ff) goes through the layers in order. An input without a range gets [-2, 2], an output
    [-4, 4], the output of a pooling layer [-2, 2]. So network inputs and pooled tensors have
    [-2, 2], all others [-4, 4]. An 8-bit integer q, from -128 to 127, stands for q * largest / 127.

    Only the inputs of products are rounded: TensorRT fuses sums and activations with the
    convolution before them, and leaves the network's outputs in float32.
    """
    return 2.0 if maker is None or maker.endswith("Pool") else 4.0
