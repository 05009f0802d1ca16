"""TensorRT as an engine: fp32, fp16, and int8.

It reads an ONNX model of the network. TensorRT 11 computes in the types of the model (strong
typing), so the model contains them: fp16 by casting the network, int8 by pairs of QuantizeLinear
and DequantizeLinear, which ONNX Runtime inserts. TensorRT requires that these are symmetric and
leave the bias in float32 (https://docs.nvidia.com/deeplearning/tensorrt, "Explicit Quantization").
"""

import warnings
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.errors import SteerbenchError, Unavailable
from bench.types import Log, SomeTensors
from methods import engines
from methods.engines import Built, Calibration, Engine, Folder, Precision, Samples

OPSET = 17

INPUT, OUTPUT = "input0", "output0"  # names in an exported network

PRODUCTS = ("Conv", "Gemm", "MatMul")
"""Operators to quantise. Sums and activations in 8 bits would cost quality and save nothing."""


class TensorRt(Engine):
    """TensorRT on a CUDA GPU. It builds plans. A plan is valid for one GPU model, one version, and
    pictures of one size; it is built when that size first occurs. With int8, everything not
    quantised is computed in float32."""

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
            self.import_library(library)

    def check(self, device: torch.device) -> None:
        if device.type != "cuda" or device.index:
            raise Unavailable(
                f"engine=tensorrt computes on the first CUDA GPU, this is device={device}: use "
                "device=cuda, and CUDA_VISIBLE_DEVICES to choose among several"
            )

    def key(self) -> Mapping[str, object]:
        """As of any engine, and the model of the GPU: plans are valid for one."""
        return {**super().key(), "gpu": torch.cuda.get_device_name()}

    def build(self, network: nn.Module, samples: Samples, folder: Folder, log: Log) -> Built:
        import onnx

        path = folder() / "network.onnx"

        def write(path: Path) -> None:
            seen, plain = [picture.cpu() for picture in samples()], deepcopy(network).cpu()
            if self.precision == "fp16":
                plain = _Halved(plain)
            exact = path if self.precision != "int8" else path.with_name("exported.onnx")
            _export(plain, seen[0], exact)
            if self.precision == "int8":
                _quantise(exact, seen, path, uncalibrated=self.uncalibrated)

        engines.keep(path, write, log)
        plans = _Plans(path, exact=self.precision != "fp16", log=log)
        weights = onnx.load(path).graph.initializer
        return Built(plans, sum(onnx.numpy_helper.to_array(weight).nbytes for weight in weights))


class _Halved(nn.Module):
    """A network in float16, with input and output in float32."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network.half()

    def forward(self, picture: Tensor) -> Tensor:
        return self.network(picture.half()).float()


def _export(module: nn.Module, sample: Tensor, path: Path) -> None:
    """Write an ONNX model of `module`, for pictures of any size."""
    import onnx

    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's own deprecations
        torch.onnx.export(
            module,
            (sample,),
            path,
            input_names=[INPUT],
            output_names=[OUTPUT],
            opset_version=OPSET,
            dynamo=False,
        )
    # Not by the exporter, which would then compute parts of weights from the sizes of pictures.
    model = onnx.load(path)
    for tensor in (*model.graph.input, *model.graph.output):
        for axis in (0, 2, 3):
            tensor.type.tensor_type.shape.dim[axis].dim_param = f"{tensor.name}, axis {axis}"
    onnx.save(model, path)


def _quantise(exported: Path, samples: SomeTensors, path: Path, *, uncalibrated: bool) -> None:
    """Quantise the products of a model to 8 bits, with ranges from `samples` or with fixed ones."""
    from onnxruntime import quantization
    from onnxruntime.quantization import shape_inference

    prepared = path.with_name("prepared.onnx")
    shape_inference.quant_pre_process(exported, prepared, skip_symbolic_shape=True)
    frames = iter([{INPUT: picture.numpy()} for picture in samples])
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
    """The plans of a model, one for each size of its input. `exact`: compute float32 in float32,
    not in TF32."""

    def __init__(self, model: Path, *, exact: bool, log: Log) -> None:
        import tensorrt

        self._tensorrt, self._logger = tensorrt, tensorrt.Logger(tensorrt.Logger.ERROR)
        self._model, self._exact, self._log = model, exact, log
        self._executions: dict[torch.Size, _Execution] = {}

    def __call__(self, picture: Tensor) -> Tensor:
        shape = picture.shape
        if shape not in self._executions:
            path = self._model.with_name(f"{'x'.join(map(str, shape))}.plan")
            engines.keep(path, lambda new: self._build(shape, new), self._log)
            self._executions[shape] = _Execution(self._tensorrt, path, self._logger)
        return self._executions[shape](picture)

    def _build(self, shape: torch.Size, path: Path) -> None:
        """Write the plan for an input of this `shape`."""
        self._log.info(f"building for TensorRT, which may take minutes: {path.stem}")
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
        profile.set_shape(INPUT, *3 * [tuple(shape)])  # least to most
        config.add_optimization_profile(profile)
        plan = builder.build_serialized_network(network, config)
        if plan is None:
            raise SteerbenchError(
                f"TensorRT {trt.__version__} cannot build {self._model} for {path.stem}; it says "
                "why above"
            )
        path.write_bytes(plan)


class _Execution:
    """A plan run on its own stream: on torch's default stream TensorRT would synchronise."""

    def __init__(self, tensorrt: Any, path: Path, logger: Any) -> None:
        engine = tensorrt.Runtime(logger).deserialize_cuda_engine(path.read_bytes())
        if engine is None:
            raise SteerbenchError(f"TensorRT cannot load its plan: remove {path} and run again")
        self._context, self._stream = engine.create_execution_context(), torch.cuda.Stream()

    def __call__(self, picture: Tensor) -> Tensor:
        picture, context, current = picture.contiguous(), self._context, torch.cuda.current_stream()
        accepted = context.set_input_shape(INPUT, tuple(picture.shape))
        shape = tuple(context.get_tensor_shape(OUTPUT)) if accepted else ()
        output = torch.empty(shape, device=picture.device)
        for name, x in ((INPUT, picture), (OUTPUT, output)):
            accepted &= context.set_tensor_address(name, x.data_ptr())
        self._stream.wait_stream(current)
        if not accepted or not context.execute_async_v3(self._stream.cuda_stream):
            size = list(picture.shape)
            raise SteerbenchError(f"TensorRT cannot run a network on {size}; it says why above")
        current.wait_stream(self._stream)
        return output
