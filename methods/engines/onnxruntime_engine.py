"""ONNX Runtime as an engine: fp32, and 8-bit integers by its own static quantisation."""

from __future__ import annotations

import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from bench.provenance import digest
from bench.results import explained
from bench.sharing import missing
from bench.types import Log
from methods.engines import Built, Engine, Inputs, Precision, readable, required
from methods.renderer2d import Network

OPSET = 17


class OnnxRuntime(Engine):
    """ONNX Runtime on the CPU.

    Raises:
        Unavailable: it, or onnx, is not installed.
    """

    name = "onnxruntime"
    precisions = ("fp32", "int8")

    def __init__(self, precision: Precision = "fp32") -> None:
        super().__init__(precision)
        required(self.name, "onnx", "onnx")
        self._runtime = required(self.name, "onnxruntime", "onnx")
        self._runtime.disable_telemetry_events()

    def key(self) -> dict[str, object]:
        """See `Engine.key`."""
        versions = {library: metadata.version(library) for library in ("onnx", "onnxruntime")}
        return {
            "engine": self.name,
            "precision": self.precision,
            "code": digest([Path(__file__)]),
            **versions,
        }

    def build(
        self,
        network: Network,
        samples: Callable[[], Sequence[Inputs]],
        folder: Callable[[], Path],
        log: Log,
    ) -> Built:
        """See `Engine.build`."""
        path = folder() / "network.onnx"
        with missing(path, log) as to_build:
            if to_build:
                self._write(network, samples(), path)
            else:
                log.info(f"built network found: {path}")
        options = self._runtime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        session = self._runtime.InferenceSession(path, options, ["CPUExecutionProvider"])
        names = [x.name for x in session.get_inputs()]

        def run(*inputs: Tensor) -> Inputs:
            told = {name: x.numpy() for name, x in zip(names, inputs, strict=True)}
            return tuple(torch.from_numpy(x) for x in session.run(None, told))

        return Built(run, _weight_bytes(path))

    def _write(self, network: Network, samples: Sequence[Inputs], path: Path) -> None:
        """Leave the model at `path`, whole or not at all."""
        with explained(path.parent), tempfile.TemporaryDirectory(dir=path.parent) as place:
            exported, ready = Path(place) / "exported.onnx", Path(place) / "ready.onnx"
            _export(network, samples[0], exported)
            if self.precision == "int8":
                _quantise(exported, samples, ready)
            else:
                ready = exported
            ready.replace(path)


def _export(network: Network, sample: Inputs, path: Path) -> None:
    names = [f"input{place}" for place in range(len(sample))]
    varying = dict(zip(names, map(list, network.varying), strict=True))
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter, on itself
        torch.onnx.export(
            readable(network),
            sample,
            path,
            input_names=names,
            dynamic_axes=varying,
            opset_version=OPSET,
            dynamo=False,
        )


def _quantise(exported: Path, samples: Sequence[Inputs], path: Path) -> None:
    from onnxruntime import quantization
    from onnxruntime.quantization import shape_inference

    prepared = path.with_name("prepared.onnx")
    shape_inference.quant_pre_process(exported, prepared, skip_symbolic_shape=True)
    quantization.quantize_static(
        prepared,
        path,
        _Reader(samples),
        quant_format=quantization.QuantFormat.QDQ,
        per_channel=True,
    )


class _Reader:
    """Inputs, one frame after the other, as ONNX Runtime asks for them."""

    def __init__(self, samples: Sequence[Inputs]) -> None:
        self._frames: Iterator[Inputs] = iter(samples)

    def get_next(self) -> dict[str, Any] | None:
        """The next frame; None after the last."""
        frame = next(self._frames, None)
        if frame is None:
            return None
        return {f"input{place}": x.numpy() for place, x in enumerate(frame)}


def _weight_bytes(path: Path) -> int:
    import onnx

    weights = onnx.load(path).graph.initializer
    return sum(onnx.numpy_helper.to_array(weight).nbytes for weight in weights)
