"""OpenVINO as an engine: fp32, bfloat16, and 8-bit integers by NNCF."""

from __future__ import annotations

import contextlib
import json
import logging
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.errors import Unavailable, explained
from bench.sharing import missing
from bench.types import Log
from methods.engines import (
    CALIBRATION,
    SIZES,
    Built,
    Engine,
    Inputs,
    Network,
    Precision,
    readable,
    required,
    sizes_to_expect,
)

# Neither OpenVINO nor NNCF is to tell anybody that it is used: both do without this package.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]

Varying = tuple[tuple[int, ...], ...]


class OpenVino(Engine):
    """OpenVINO on the CPU.

    With int8, what is not quantised is computed in bfloat16 where the CPU has it, else in float32.

    Raises:
        Unavailable: it, or for int8 NNCF, is not installed; or it has no bfloat16 on this CPU, for
            which it would take float32 without a word.
    """

    name = "openvino"
    precisions = ("fp32", "bf16", "int8")
    libraries = ("openvino", "nncf")

    def __init__(self, precision: Precision = "fp32") -> None:
        super().__init__(precision)
        self._openvino = required(self.name, "openvino", "openvino")
        self._nncf = required(self.name, "nncf", "openvino") if precision == "int8" else None
        if precision == "bf16" and "BF16" not in _capabilities(self._openvino):
            raise Unavailable(
                "precision=bf16: engine=openvino has no bfloat16 on this CPU, use precision=fp32"
            )

    def samples(self, network: Network) -> int:
        """See `Engine.samples`: enough to know the sizes that come."""
        return CALIBRATION if any(network.varying) else super().samples(network)

    def build(
        self,
        network: Network,
        samples: Callable[[], Sequence[Inputs]],
        folder: Callable[[], Path],
        log: Log,
    ) -> Built:
        """See `Engine.build`."""
        path = folder() / "network.xml"
        with missing(path, log) as to_build:
            if to_build:
                seen = samples()
                model = self._convert(network, seen)
                model.set_rt_info(json.dumps(sizes_to_expect(seen, network)), SIZES)
                self._write(model, path)
            else:
                log.info(f"built network found: {path}")
        model = self._openvino.Core().read_model(path)
        compiled = _Compiled(self._openvino, model, network.varying, self.precision)
        sizes = json.loads(model.get_rt_info(SIZES).value)
        with log.progress("compiling", len(sizes)) as progress:
            for size in sizes:
                compiled.prepare(size)
                progress.advance()
        weights = [op for op in model.get_ops() if op.get_type_name() == "Constant"]
        return Built(compiled, sum(op.data.nbytes for op in weights))

    def _convert(self, network: Network, samples: Sequence[Inputs]) -> Any:
        shapes = [list(x.shape) for x in samples[0]]
        for shape, axes in zip(shapes, network.varying, strict=True):
            for axis in axes:
                shape[axis] = -1
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of the tracer: on itself, and on checks of arguments
            model = self._openvino.convert_model(
                readable(network), example_input=samples[0], input=shapes
            )
        if self._nncf is None:
            return model
        logging.getLogger("nncf").setLevel(logging.ERROR)
        frames = self._nncf.Dataset(samples, lambda inputs: [x.numpy() for x in inputs])
        with contextlib.redirect_stdout(sys.stderr):  # its progress bars
            return self._nncf.quantize(
                model,
                frames,
                preset=self._nncf.QuantizationPreset.MIXED,  # activations are not symmetric
                subset_size=len(samples),
            )

    def _write(self, model: Any, path: Path) -> None:
        """Leave the model at `path`, whole or not at all."""
        with explained(path.parent), tempfile.TemporaryDirectory(dir=path.parent) as place:
            new = Path(place) / path.name
            self._openvino.save_model(model, new, compress_to_fp16=self.precision == "bf16")
            new.with_suffix(".bin").replace(path.with_suffix(".bin"))
            new.replace(path)


def _capabilities(openvino: Any) -> list[str]:
    return openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


class _Compiled:
    """A model, compiled for every size of its inputs that comes: a fixed size is a third faster."""

    def __init__(self, openvino: Any, model: Any, varying: Varying, precision: Precision) -> None:
        self._model, self._varying, self._core = model, varying, openvino.Core()
        self._requests: dict[tuple[tuple[int, ...], ...], Any] = {}
        self._settings = {
            "INFERENCE_PRECISION_HINT": "f32" if precision == "fp32" else "bf16",
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_NUM_THREADS": torch.get_num_threads(),
        }

    def prepare(self, size: int) -> None:
        """Compile for varying axes of `size`; what is done at the first call is done, too."""
        told = []
        for port, axes in zip(self._model.inputs, self._varying, strict=True):
            shape = [
                size if axis in axes else part.get_length()
                for axis, part in enumerate(port.partial_shape)
            ]
            told.append(np.zeros(shape, port.element_type.to_dtype()))
        self._request(tuple(x.shape for x in told)).infer(told)

    def __call__(self, *inputs: Tensor) -> Inputs:
        arrays = [x.contiguous().numpy() for x in inputs]
        request = self._request(tuple(x.shape for x in arrays))
        found = request.infer(arrays, share_inputs=True, share_outputs=True)
        return tuple(torch.from_numpy(found[place]) for place in range(len(found)))

    def _request(self, shapes: tuple[tuple[int, ...], ...]) -> Any:
        if shapes not in self._requests:
            model = self._model.clone()
            model.reshape(dict(enumerate(map(list, shapes))))
            compiled = self._core.compile_model(model, "CPU", self._settings)
            self._requests[shapes] = compiled.create_infer_request()
        return self._requests[shapes]
