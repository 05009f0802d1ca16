"""OpenVINO as an engine: fp32, bfloat16, and 8-bit integers by NNCF."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.types import Log
from methods.engines import Built, Engine, Inputs, Precision, required
from methods.renderer2d import Network

# Neither OpenVINO nor NNCF is to tell anybody that it is used: both do without this package.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]


class OpenVino(Engine):
    """OpenVINO on the CPU.

    Raises:
        Unavailable: it, or for int8 NNCF, is not installed.
    """

    name = "openvino"
    precisions = ("fp32", "bf16", "int8")

    def __init__(self, precision: Precision = "fp32") -> None:
        super().__init__(precision)
        self._openvino = required("openvino", "openvino")
        self._nncf = required("nncf", "openvino") if precision == "int8" else None

    def key(self) -> dict[str, object]:
        """See `Engine.key`."""
        libraries = ("openvino", "nncf") if self._nncf else ("openvino",)
        versions = {library: metadata.version(library) for library in libraries}
        # What bfloat16 is read from is float32.
        stored = "int8" if self.precision == "int8" else "fp32"
        return {"engine": self.name, "stored": stored, "code": 1, **versions}

    def build(
        self,
        network: Network,
        samples: Callable[[], Sequence[Inputs]],
        folder: Callable[[], Path],
        log: Log,
    ) -> Built:
        """See `Engine.build`."""
        path = folder() / "network.xml"
        if path.exists():
            log.info(f"built network found: {path}")
        else:
            self._write(self._convert(network, samples()), path)
        model = self._openvino.Core().read_model(path)
        size = sum(op.data.nbytes for op in model.get_ops() if op.get_type_name() == "Constant")
        return Built(_Compiled(self._openvino, model, self.precision), size)

    def _convert(self, network: Network, samples: Sequence[Inputs]) -> Any:
        readable = deepcopy(network)
        readable.backend = "reference"
        shapes = [list(x.shape) for x in samples[0]]
        for shape, axes in zip(shapes, network.varying, strict=True):
            for axis in axes:
                shape[axis] = -1
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the tracer: on itself, and on checks of arguments
            model = self._openvino.convert_model(readable, example_input=samples[0], input=shapes)
        if self._nncf is None:
            return model
        logging.getLogger("nncf").setLevel(logging.ERROR)
        frames = self._nncf.Dataset(samples, lambda inputs: [x.numpy() for x in inputs])
        return self._nncf.quantize(model, frames, subset_size=len(samples))

    def _write(self, model: Any, path: Path) -> None:
        """Leave the model at `path`, whole or not at all."""
        new = path.with_name("new.xml")
        self._openvino.save_model(model, new, compress_to_fp16=False)
        new.with_suffix(".bin").replace(path.with_suffix(".bin"))
        new.replace(path)


class _Compiled:
    """A model, compiled for every size of its inputs that comes: a fixed size is a third faster."""

    def __init__(self, openvino: Any, model: Any, precision: Precision) -> None:
        self._model, self._core = model, openvino.Core()
        self._requests: dict[tuple[torch.Size, ...], Any] = {}
        self._settings = {
            "INFERENCE_PRECISION_HINT": "f32" if precision == "fp32" else "bf16",
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": torch.get_num_threads(),
        }

    def __call__(self, *inputs: Tensor) -> Inputs:
        arrays = [x.contiguous().numpy() for x in inputs]
        shapes = tuple(x.shape for x in inputs)
        if shapes not in self._requests:
            model = self._model.clone()
            model.reshape({place: list(shape) for place, shape in enumerate(shapes)})
            compiled = self._core.compile_model(model, "CPU", self._settings)
            self._requests[shapes] = compiled.create_infer_request()
        found = self._requests[shapes].infer(arrays, share_inputs=True, share_outputs=True)
        return tuple(torch.from_numpy(found[i]) for i in range(len(found)))
