"""A network as an ONNX model, for the engines that read one: exported, and quantised to 8 bits."""

from __future__ import annotations

import json
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from bench.errors import explained
from bench.sharing import missing
from bench.types import Log
from methods.engines import SIZES, Inputs, Network, Precision, readable, sizes_to_expect

OPSET = 17

PRODUCTS = ("Conv", "Gemm", "MatMul")
"""What is quantised. Sums and activations between them gain nothing from 8 bits, and lose."""


def kept(
    network: Network,
    samples: Callable[[], Sequence[Inputs]],
    folder: Callable[[], Path],
    precision: Precision,
    log: Log,
    options: Mapping[str, bool] | None = None,
) -> Path:
    """Where `network` lies in `folder` as a model, which is made there if it is missing.

    Args:
        samples: called if they are needed: inputs of one frame, or of those to calibrate on.
        precision: fp32; fp16, with inputs and outputs in float32; or int8, with what is not
            quantised in float32.
        options: further ones of ONNX Runtime's quantiser.
    """
    path = folder() / "network.onnx"
    with missing(path, log) as to_build:
        if to_build:
            _write(network, samples(), path, precision, options or {})
        else:
            log.info(f"built network found: {path}")
    return path


def _write(
    network: Network,
    samples: Sequence[Inputs],
    path: Path,
    precision: Precision,
    options: Mapping[str, bool],
) -> None:
    """Leave the model at `path`, whole or not at all."""
    samples = [tuple(x.cpu() for x in inputs) for inputs in samples]
    plain = readable(network).cpu()
    with explained(path.parent), tempfile.TemporaryDirectory(dir=path.parent) as place:
        exported, ready = Path(place) / "exported.onnx", Path(place) / "ready.onnx"
        _export(_Halved(plain) if precision == "fp16" else plain, network, samples[0], exported)
        if precision == "int8":
            frames = _Reader(samples, input_names(network))
            _quantise(exported, frames, ready, options)
        else:
            ready = exported
        _note_sizes(ready, sizes_to_expect(samples, network))
        ready.replace(path)


def input_names(network: Network) -> list[str]:
    """What the inputs of an exported `network` are called, in order."""
    return [f"input{place}" for place in range(len(network.varying))]


def output_names(count: int) -> list[str]:
    """What `count` outputs of an exported network are called, in order."""
    return [f"output{place}" for place in range(count)]


def sizes(path: Path) -> list[int]:
    """The sizes to expect of varying axes, as told by the samples that a model was made with."""
    import onnx

    noted = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
    return json.loads(noted[SIZES])


def weight_bytes(path: Path) -> int:
    """Bytes of all constants of a model."""
    import onnx

    weights = onnx.load(path).graph.initializer
    return sum(onnx.numpy_helper.to_array(weight).nbytes for weight in weights)


def _note_sizes(path: Path, expected: list[int]) -> None:
    import onnx

    model = onnx.load(path)
    onnx.helper.set_model_props(model, {SIZES: json.dumps(expected)})
    onnx.save(model, path)


class _Halved(nn.Module):
    """A network in float16, told and saying float32."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.half()

    def forward(self, *inputs: Tensor) -> Inputs:
        told = (x.half() if x.is_floating_point() else x for x in inputs)
        return tuple(x.float() for x in self.network(*told))


def _export(module: nn.Module, network: Network, sample: Inputs, path: Path) -> None:
    names = input_names(network)
    varying = dict(zip(names, map(list, network.varying), strict=True))
    with torch.no_grad(), warnings.catch_warnings():
        outputs = len(module(*sample))
        warnings.simplefilter("ignore")  # of the exporter, on itself
        torch.onnx.export(
            module,
            sample,
            path,
            input_names=names,
            output_names=output_names(outputs),
            dynamic_axes=varying,
            opset_version=OPSET,
            dynamo=False,
        )


def _quantise(exported: Path, frames: _Reader, path: Path, options: Mapping[str, bool]) -> None:
    from onnxruntime import quantization
    from onnxruntime.quantization import shape_inference

    prepared = path.with_name("prepared.onnx")
    shape_inference.quant_pre_process(exported, prepared, skip_symbolic_shape=True)
    quantization.quantize_static(
        prepared,
        path,
        frames,
        quant_format=quantization.QuantFormat.QDQ,
        per_channel=True,
        op_types_to_quantize=list(PRODUCTS),
        extra_options=dict(options),
    )


class _Reader:
    """Inputs, one frame after the other, as ONNX Runtime asks for them."""

    def __init__(self, samples: Sequence[Inputs], names: Sequence[str]) -> None:
        self._frames, self._names = iter(samples), names

    def get_next(self) -> dict[str, Any] | None:
        """The next frame; None after the last."""
        frame = next(self._frames, None)
        if frame is None:
            return None
        return {name: x.numpy() for name, x in zip(self._names, frame, strict=True)}
