"""TensorRT as `methods.engines.tensorrt_engine` uses it, on the CPU by ONNX Runtime.

Names and arguments are those of the Python bindings of TensorRT 11.4. A plan is the ONNX model with
the sizes that it is good for in front; memory is read and written at the given addresses.
"""

from __future__ import annotations

import ctypes
import json
import math
from collections.abc import Sequence
from enum import Enum, IntEnum
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnxruntime

__version__ = "11.4.0"


class Logger:
    ERROR = 1

    def __init__(self, min_severity: int) -> None: ...


class NetworkDefinitionCreationFlag(IntEnum):
    STRONGLY_TYPED = 0


class BuilderFlag(Enum):
    TF32 = 3


class Network:
    """What a parser reads into."""

    model: bytes


class Builder:
    """Also its own config, and the one profile of that."""

    built = 0

    def __init__(self, logger: Logger) -> None:
        self.shapes: dict[str, list[list[int]]] = {}
        self.profiles = 0

    def create_network(self, flags: int) -> Network:
        assert flags == 1 << NetworkDefinitionCreationFlag.STRONGLY_TYPED.value
        return Network()

    def create_builder_config(self) -> Builder:
        return self

    create_optimization_profile = create_builder_config

    def clear_flag(self, flag: BuilderFlag) -> None: ...

    def set_shape(
        self, input: str, min: Sequence[int], opt: Sequence[int], max: Sequence[int]
    ) -> None:
        assert all(a <= b <= c for a, b, c in zip(min, opt, max, strict=True))
        self.shapes[input] = [list(min), list(max)]

    def add_optimization_profile(self, profile: Builder) -> int:
        self.profiles += 1
        return 0

    def build_serialized_network(self, network: Network, config: Builder) -> bytes | None:
        assert config.profiles == 1
        Builder.built += 1
        return json.dumps(config.shapes).encode() + b"\n" + network.model


class OnnxParser:
    num_errors = 1

    def __init__(self, network: Network, logger: Logger) -> None:
        self._network = network

    def parse_from_file(self, model: str) -> bool:
        self._network.model = Path(model).read_bytes()
        return True

    def get_error(self, index: int) -> SimpleNamespace:
        return SimpleNamespace(desc=lambda: "no such operator")


class Runtime:
    def __init__(self, logger: Logger) -> None: ...

    def deserialize_cuda_engine(self, serialized_engine: bytes) -> CudaEngine | None:
        shapes, found, model = serialized_engine.partition(b"\n")
        return CudaEngine(json.loads(shapes), model) if found else None


class CudaEngine:
    """Also its one execution context."""

    def __init__(self, limits: dict[str, list[list[int]]], model: bytes) -> None:
        self._limits, self._session = limits, onnxruntime.InferenceSession(model)
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._addresses: dict[str, int] = {}

    def create_execution_context(self) -> CudaEngine:
        return self

    def set_input_shape(self, name: str, shape: tuple[int, ...]) -> bool:
        least, most = self._limits[name]
        self._shapes[name] = shape
        return all(a <= b <= c for a, b, c in zip(least, shape, most, strict=True))

    def set_tensor_address(self, name: str, memory: int) -> bool:
        self._addresses[name] = memory
        return True

    def get_tensor_shape(self, name: str) -> tuple[int, ...]:
        zeros = {x: np.zeros(shape, np.float32) for x, shape in self._shapes.items()}
        return self._session.run([name], zeros)[0].shape

    def execute_async_v3(self, stream_handle: int) -> bool:
        given = {name: self._memory(name, shape) for name, shape in self._shapes.items()}
        (output,) = self._session.get_outputs()
        (value,) = self._session.run([output.name], given)
        self._memory(output.name, value.shape)[...] = value
        return True

    def _memory(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        raw = (ctypes.c_float * math.prod(shape)).from_address(self._addresses[name])
        return np.frombuffer(raw, np.float32).reshape(shape)


class Stream:
    """One of CUDA's, for `torch.cuda`."""

    cuda_stream = 7

    def wait_stream(self, stream: Stream) -> None: ...
