"""TensorRT as an engine: fp32, fp16, and int8.

It reads an ONNX model of the network. TensorRT 11 computes in the types of the model (strong
typing), so the model contains them: fp16 by casting the network, int8 by pairs of QuantizeLinear
and DequantizeLinear, which ONNX Runtime inserts. TensorRT requires that these are symmetric and
leave the bias in float32 (https://docs.nvidia.com/deeplearning/tensorrt, "Explicit Quantization").
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

from bench.errors import SteerbenchError, Unavailable
from bench.types import Log
from methods import engines
from methods.engines import Built, Calibration, Engine, Folder, Inputs, Network, Precision, Samples

OPSET = 17

PRODUCTS = ("Conv", "Gemm", "MatMul")
"""Operators to quantise. Sums and activations in 8 bits would cost quality and save nothing."""


class TensorRt(Engine):
    """TensorRT on a CUDA GPU.

    It builds plans. A plan is valid for one GPU model, one version, and up to a number of cells,
    which is a power of two. Plans for expected sizes are built beforehand, others on demand. With
    int8, everything not quantised is computed in float32.
    """

    name = "tensorrt"
    precisions = ("fp32", "fp16", "int8")
    libraries = ("onnx", "onnxruntime", "tensorrt")

    def __init__(self, precision: Precision = "fp32", calibration: Calibration = "frames") -> None:
        super().__init__(precision, calibration)
        if not torch.cuda.is_available():
            raise Unavailable(
                "engine=tensorrt computes on a CUDA GPU, and torch sees none here: use "
                "engine=openvino"
            )
        for library in self.libraries:
            self.load(library)

    def check(self, device: torch.device) -> None:
        """Raise `Unavailable` unless `device` is the first CUDA GPU."""
        if device.type != "cuda" or device.index:
            raise Unavailable(
                f"engine=tensorrt computes on the first CUDA GPU, this is device={device}: use "
                "device=cuda, and CUDA_VISIBLE_DEVICES to choose among several"
            )

    def key(self) -> dict[str, object]:
        """As of any engine, and the model of the GPU: plans are valid for one."""
        return super().key() | {"gpu": torch.cuda.get_device_name()}

    def build(self, network: Network, samples: Samples, folder: Folder, log: Log) -> Built:
        """Export `network` as an ONNX model, and build plans for the sizes to expect."""
        import onnx

        path = folder() / "network.onnx"

        def write(path: Path, seen: Sequence[Inputs]) -> None:
            seen = [tuple(x.cpu() for x in inputs) for inputs in seen]
            plain: nn.Module = engines.readable(network).cpu()
            if self.precision == "fp16":
                plain = _Halved(plain)
            exact = path if self.precision != "int8" else path.with_name("exported.onnx")
            _export(plain, network, seen[0], exact)
            if self.precision == "int8":
                _quantise(exact, seen, path, uncalibrated=self.uncalibrated)

        sizes = engines.keep_model(path, network, samples, write, log)
        plans = _Plans(path, network, exact=self.precision != "fp16", log=log)
        plans.prepare(sizes)
        weights = onnx.load(path).graph.initializer
        return Built(plans, sum(onnx.numpy_helper.to_array(weight).nbytes for weight in weights))


class _Halved(nn.Module):
    """A network in float16, with inputs and outputs in float32."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.half()

    def forward(self, *inputs: Tensor) -> Inputs:
        halved = (x.half() if x.is_floating_point() else x for x in inputs)
        return tuple(x.float() for x in self.network(*halved))


def _names(kind: str, count: int) -> list[str]:
    """Names of `count` inputs or outputs (the `kind`) of an exported network, in order."""
    return [f"{kind}{place}" for place in range(count)]


def _export(module: nn.Module, network: Network, sample: Inputs, path: Path) -> None:
    inputs = _names("input", len(sample))
    with torch.no_grad(), warnings.catch_warnings():
        outputs = len(module(*sample))
        warnings.simplefilter("ignore")  # the exporter's own deprecations
        torch.onnx.export(
            module,
            sample,
            path,
            input_names=inputs,
            output_names=_names("output", outputs),
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
        dict(zip(_names("input", len(inputs)), (x.numpy() for x in inputs), strict=True))
        for inputs in samples
    )
    symmetric = {"ActivationSymmetric": True, "QuantizeBias": False}
    quantization.quantize_static(
        prepared,
        path,
        SimpleNamespace(get_next=lambda: next(frames, None)),
        quant_format=quantization.QuantFormat.QDQ,
        per_channel=True,
        op_types_to_quantize=list(PRODUCTS),
        extra_options={**symmetric, **(_fixed_ranges(prepared) if uncalibrated else {})},
    )


def _fixed_ranges(prepared: Path) -> dict[str, Any]:
    """Options of the quantiser that set the ranges of `engines.largest`, whatever the samples
    contain. A tensor padded with zeros keeps its range."""
    import onnx

    graph = onnx.load(prepared).graph
    bounds = {entry.name: engines.largest(None) for entry in graph.input}
    for node in graph.node:
        padded = bounds.get(node.input[0]) if node.op_type == "Pad" else None
        for name in node.output:
            bounds[name] = padded or engines.largest(node.op_type)
    read = {name for node in graph.node if node.op_type in PRODUCTS for name in node.input}
    zero = np.array(0, np.int8)
    return {
        "OpTypesToExcludeOutputQuantization": list(PRODUCTS),
        "TensorQuantOverrides": {
            name: [{"scale": np.array(bounds[name] / 127, np.float32), "zero_point": zero}]
            for name in sorted(read & bounds.keys())
        },
    }


class _Plans:
    """The plans of a model: for every n, one for up to 2^n cells, built when it is first needed.

    `exact`: compute float32 in float32, not in TF32.
    """

    def __init__(self, model: Path, network: Network, *, exact: bool, log: Log) -> None:
        import tensorrt

        self._tensorrt, self._logger = tensorrt, tensorrt.Logger(tensorrt.Logger.ERROR)
        self._model, self._network, self._exact, self._log = model, network, exact, log
        self._executions: dict[int, _Execution] = {}

    def prepare(self, sizes: Sequence[int]) -> None:
        """Build the plans for these numbers of cells; a network of fixed size has one plan."""
        ceilings = sorted({_ceiling(size) for size in sizes or [1]})
        with self._log.progress("building for TensorRT", len(ceilings)) as progress:
            for ceiling in ceilings:
                self._execution(ceiling)
                progress.advance(note=f"up to {ceiling} cells" if sizes else "")

    def __call__(self, *inputs: Tensor) -> Inputs:
        if not all(x.numel() for x in inputs):
            return self._network(*inputs)
        size = len(inputs[0]) if self._network.varying else 1
        return self._execution(_ceiling(size))(*inputs)

    def _execution(self, ceiling: int) -> _Execution:
        if ceiling not in self._executions:
            path = self._model.with_name(f"upto-{ceiling}.plan")
            engines.keep(path, lambda new: self._build(ceiling, new), self._log)
            self._executions[ceiling] = _Execution(self._tensorrt, path, self._logger)
        return self._executions[ceiling]

    def _build(self, ceiling: int, path: Path) -> None:
        """Write the plan for 1 to `ceiling` cells, optimised for `ceiling`."""
        trt = self._tensorrt
        builder = trt.Builder(self._logger)
        typed = 1 << int(trt.NetworkDefinitionCreationFlag.STRONGLY_TYPED)
        network, config = builder.create_network(typed), builder.create_builder_config()
        parser = trt.OnnxParser(network, self._logger)
        if not parser.parse_from_file(str(self._model)):
            found = "; ".join(parser.get_error(at).desc() for at in range(parser.num_errors))
            raise SteerbenchError(f"TensorRT {trt.__version__} cannot read {self._model}: {found}")
        if self._exact:
            config.clear_flag(trt.BuilderFlag.TF32)
        profile = builder.create_optimization_profile()
        for tensor in map(network.get_input, range(network.num_inputs)):
            shapes = (
                [size if axis == -1 else axis for axis in tensor.shape]
                for size in (1, ceiling, ceiling)  # minimum, optimum, maximum
            )
            profile.set_shape(tensor.name, *shapes)
        config.add_optimization_profile(profile)
        plan = builder.build_serialized_network(network, config)
        if plan is None:
            raise SteerbenchError(
                f"TensorRT {trt.__version__} cannot build {self._model} for up to {ceiling} cells; "
                "it says why above"
            )
        path.write_bytes(plan)


class _Execution:
    """A plan run on its own stream: on torch's default stream TensorRT would synchronise."""

    def __init__(self, tensorrt: Any, path: Path, logger: Any) -> None:
        engine = tensorrt.Runtime(logger).deserialize_cuda_engine(path.read_bytes())
        if engine is None:
            raise SteerbenchError(f"TensorRT cannot load its plan: remove {path} and run again")
        self._context = engine.create_execution_context()
        self._tensors, self._stream = engine.num_io_tensors, torch.cuda.Stream()

    def __call__(self, *inputs: Tensor) -> Inputs:
        inputs, context = tuple(x.contiguous() for x in inputs), self._context
        named = dict(zip(_names("input", len(inputs)), inputs, strict=True))
        accepted = [context.set_input_shape(name, tuple(x.shape)) for name, x in named.items()]
        outputs = _names("output", self._tensors - len(inputs)) if all(accepted) else []
        for name in outputs:
            shape = tuple(context.get_tensor_shape(name))
            named[name] = torch.empty(shape, device=inputs[0].device)
        accepted += [context.set_tensor_address(name, x.data_ptr()) for name, x in named.items()]
        current = torch.cuda.current_stream()
        self._stream.wait_stream(current)
        if not all(accepted) or not context.execute_async_v3(self._stream.cuda_stream):
            shapes = ", ".join(str(list(x.shape)) for x in inputs)
            raise SteerbenchError(f"TensorRT cannot run a network on {shapes}; it says why above")
        current.wait_stream(self._stream)
        return tuple(named[name] for name in outputs)


def _ceiling(size: int) -> int:
    """The smallest power of two that is at least `size`; at least 1."""
    return 1 << max(size - 1, 0).bit_length()
