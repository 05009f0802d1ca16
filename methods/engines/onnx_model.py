"""Exports a network as an ONNX model, for engines that read one, and quantises it to 8 bits."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.types import Log
from methods.engines import (
    SIZES,
    Engine,
    Folder,
    Inputs,
    Network,
    Samples,
    keep,
    readable,
    sizes_to_expect,
)
from methods.engines.fixed_ranges import largest

OPSET = 17

PRODUCTS = ("Conv", "Gemm", "MatMul")
"""Operators to quantise. Sums and activations in 8 bits would cost quality and save nothing."""


def kept(
    network: Network,
    samples: Samples,
    folder: Folder,
    engine: Engine,
    log: Log,
    options: Mapping[str, Any] | None = None,
) -> Path:
    """The path of the ONNX model of `network` in `folder`; the model is made if it is missing.

    Args:
        network: the network to export.
        samples: inputs of one frame, or of the frames to calibrate on.
        folder: reserved for this network and engine.
        engine: its precision is that of the model: fp32; fp16, with inputs and outputs in float32;
            or int8, with the rest in float32, and with `fixed_ranges` if uncalibrated.
        log: shows what is found or made.
        options: further options of ONNX Runtime's quantiser.

    Raises:
        SteerbenchError: the folder cannot be written to.
    """

    def write(path: Path) -> None:
        seen = [tuple(x.cpu() for x in inputs) for inputs in samples()]
        plain = readable(network).cpu()
        if engine.precision == "int8":
            exported, prepared = path.with_name("exported.onnx"), path.with_name("prepared.onnx")
            _export(plain, network, seen[0], exported)
            _prepare(exported, prepared)
            further = _uncalibrated(prepared) if engine.uncalibrated else {}
            _quantise(prepared, seen, input_names(network), path, {**(options or {}), **further})
        else:
            half = engine.precision == "fp16"
            _export(_Halved(plain) if half else plain, network, seen[0], path)
        _note_sizes(path, sizes_to_expect(seen, network))

    path = folder() / "network.onnx"
    keep(path, write, log)
    return path


def input_names(network: Network) -> list[str]:
    """Names of the inputs of an exported `network`, in order."""
    return [f"input{place}" for place in range(len(network.varying))]


def output_names(count: int) -> list[str]:
    """Names of `count` outputs of an exported network, in order."""
    return [f"output{place}" for place in range(count)]


def sizes(path: Path) -> list[int]:
    """The sizes of varying axes to expect, as stored in the model's metadata."""
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
    """A network in float16, with inputs and outputs in float32."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.half()

    def forward(self, *inputs: Tensor) -> Inputs:
        halved = (x.half() if x.is_floating_point() else x for x in inputs)
        return tuple(x.float() for x in self.network(*halved))


def _export(module: nn.Module, network: Network, sample: Inputs, path: Path) -> None:
    names = input_names(network)
    varying = dict(zip(names, map(list, network.varying), strict=True))
    with torch.no_grad(), warnings.catch_warnings():
        outputs = len(module(*sample))
        warnings.simplefilter("ignore")  # the exporter's own deprecations
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


def _prepare(exported: Path, prepared: Path) -> None:
    from onnxruntime.quantization import shape_inference

    shape_inference.quant_pre_process(exported, prepared, skip_symbolic_shape=True)


def _uncalibrated(prepared: Path) -> dict[str, Any]:
    """Options of the quantiser that set `fixed_ranges`, whatever the samples contain.

    A tensor padded with zeros keeps its range.
    """
    import onnx

    graph = onnx.load(prepared).graph
    bounds = {entry.name: largest(None) for entry in graph.input}
    for node in graph.node:
        padded = bounds.get(node.input[0]) if node.op_type == "Pad" else None
        for name in node.output:
            bounds[name] = padded or largest(node.op_type)
    read = {name for node in graph.node if node.op_type in PRODUCTS for name in node.input}
    zero = np.array(0, np.int8)
    return {
        "OpTypesToExcludeOutputQuantization": list(PRODUCTS),
        "TensorQuantOverrides": {
            name: [{"scale": np.array(bounds[name] / 127, np.float32), "zero_point": zero}]
            for name in sorted(read & bounds.keys())
        },
    }


def _quantise(
    prepared: Path,
    samples: Sequence[Inputs],
    names: Sequence[str],
    path: Path,
    options: Mapping[str, Any],
) -> None:
    """Quantise the products of the model `prepared` to 8 bits, calibrated on `samples`."""
    from onnxruntime import quantization

    arrays = [[x.numpy() for x in inputs] for inputs in samples]
    frames = iter([dict(zip(names, frame, strict=True)) for frame in arrays])
    quantization.quantize_static(
        prepared,
        path,
        SimpleNamespace(get_next=lambda: next(frames, None)),
        quant_format=quantization.QuantFormat.QDQ,
        per_channel=True,
        op_types_to_quantize=list(PRODUCTS),
        extra_options=dict(options),
    )
