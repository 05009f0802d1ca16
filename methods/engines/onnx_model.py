"""Exports a network as an ONNX model for TensorRT, and quantises it to 8 bits with ONNX Runtime.

TensorRT 11 computes in the types of the model (strong typing), so the model contains them: fp16 by
casting the network, int8 by pairs of QuantizeLinear and DequantizeLinear. TensorRT requires that
these are symmetric and leave the bias in float32
(https://docs.nvidia.com/deeplearning/tensorrt, "Explicit Quantization").
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.types import Log
from methods.engines import Engine, Folder, Inputs, Network, Samples, keep, note_sizes, readable
from methods.engines.fixed_ranges import largest

OPSET = 17

PRODUCTS = ("Conv", "Gemm", "MatMul")
"""Operators to quantise. Sums and activations in 8 bits would cost quality and save nothing."""

SYMMETRIC = {"ActivationSymmetric": True, "QuantizeBias": False}


def kept(network: Network, samples: Samples, folder: Folder, engine: Engine, log: Log) -> Path:
    """The path of the ONNX model of `network` in `folder`; the model is made if it is missing.

    Args:
        network: the network to export.
        samples: inputs of one frame, or of the frames to calibrate on.
        folder: reserved for this network and engine.
        engine: its precision is that of the model: fp32; fp16, with inputs and outputs in float32;
            or int8, with the rest in float32, and with `fixed_ranges` if uncalibrated.
        log: shows what is found or made.

    Raises:
        SteerbenchError: the folder cannot be written to.
    """

    def write(path: Path) -> None:
        seen = [tuple(x.cpu() for x in inputs) for inputs in samples()]
        plain: nn.Module = readable(network).cpu()
        if engine.precision == "fp16":
            plain = _Halved(plain)
        exact = path if engine.precision != "int8" else path.with_name("exported.onnx")
        _export(plain, network, seen[0], exact)
        if engine.precision == "int8":
            _quantise(exact, seen, path, uncalibrated=engine.uncalibrated)
        note_sizes(path, seen, network)

    path = folder() / "network.onnx"
    keep(path, write, log)
    return path


def weight_bytes(path: Path) -> int:
    """Bytes of all constants of a model."""
    import onnx

    weights = onnx.load(path).graph.initializer
    return sum(onnx.numpy_helper.to_array(weight).nbytes for weight in weights)


def names(kind: str, count: int) -> list[str]:
    """Names of `count` inputs or outputs (the `kind`) of an exported network, in order."""
    return [f"{kind}{place}" for place in range(count)]


class _Halved(nn.Module):
    """A network in float16, with inputs and outputs in float32."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.half()

    def forward(self, *inputs: Tensor) -> Inputs:
        halved = (x.half() if x.is_floating_point() else x for x in inputs)
        return tuple(x.float() for x in self.network(*halved))


def _export(module: nn.Module, network: Network, sample: Inputs, path: Path) -> None:
    inputs = names("input", len(sample))
    with torch.no_grad(), warnings.catch_warnings():
        outputs = len(module(*sample))
        warnings.simplefilter("ignore")  # the exporter's own deprecations
        torch.onnx.export(
            module,
            sample,
            path,
            input_names=inputs,
            output_names=names("output", outputs),
            dynamic_axes={name: [0] for name in inputs if network.varying},
            opset_version=OPSET,
            dynamo=False,
        )


def _quantise(exported: Path, samples: Sequence[Inputs], path: Path, *, uncalibrated: bool) -> None:
    """Quantise the products of a model to 8 bits, with ranges from `samples` or with fixed ones."""
    from onnxruntime import quantization
    from onnxruntime.quantization import shape_inference

    prepared = path.with_name("prepared.onnx")
    shape_inference.quant_pre_process(exported, prepared, skip_symbolic_shape=True)
    frames = iter(
        dict(zip(names("input", len(inputs)), (x.numpy() for x in inputs), strict=True))
        for inputs in samples
    )
    quantization.quantize_static(
        prepared,
        path,
        SimpleNamespace(get_next=lambda: next(frames, None)),
        quant_format=quantization.QuantFormat.QDQ,
        per_channel=True,
        op_types_to_quantize=list(PRODUCTS),
        extra_options={**SYMMETRIC, **(_uncalibrated(prepared) if uncalibrated else {})},
    )


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
