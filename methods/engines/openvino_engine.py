"""OpenVINO as an engine: fp32, bfloat16, and int8 by NNCF."""

import contextlib
import logging
import sys
import warnings
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from bench.errors import Unavailable
from bench.types import Log, SomeTensors
from methods import engines
from methods.engines import Built, Calibration, Engine, Folder, Precision, Samples

# Disables the telemetry of OpenVINO and NNCF; both work without this package.
sys.modules.setdefault("openvino_telemetry", None)  # type: ignore[arg-type]

NO_PRODUCTS = ("Add", "Multiply", "MaxPool")
"""Operators whose inputs NNCF would also round, unlike TensorRT: see `engines.largest`."""


class OpenVino(Engine):
    """OpenVINO on the CPU.

    With int8, everything not quantised is computed in bfloat16 if the CPU has it, otherwise in
    float32. Where the CPU lacks bfloat16, OpenVINO would compute in float32 without saying so:
    then `bf16` is refused.
    """

    name = "openvino"
    precisions = ("fp32", "bf16", "int8")
    libraries = ("openvino", "nncf")

    def __init__(self, precision: Precision = "fp32", calibration: Calibration = "frames") -> None:
        super().__init__(precision, calibration)
        self._openvino = self.import_library("openvino")
        self._nncf = self.import_library("nncf") if precision == "int8" else None
        self._half = precision != "fp32" and "BF16" in _capabilities(self._openvino)
        self._dtype = torch.bfloat16 if self._half else torch.float32  # of input pictures
        if precision == "bf16" and not self._half:
            raise Unavailable(
                "precision=bf16: engine=openvino has no bfloat16 on this CPU, use precision=fp32"
            )

    def computed(self, device: torch.device) -> str:
        computed = super().computed(device)
        return computed.replace("+fp32", "+bf16") if self._half else computed

    def build(self, network: nn.Module, samples: Samples, folder: Folder, log: Log) -> Built:

        def write(path: Path) -> None:
            model = self._channels_last(self._convert(network, samples()))
            self._openvino.save_model(model, path, compress_to_fp16=self.precision == "bf16")

        path = folder() / "network.xml"
        engines.keep(path, write, log)
        model = self._openvino.Core().read_model(path)
        weights = [op for op in model.get_ops() if op.get_type_name() == "Constant"]
        size = sum(op.data.nbytes for op in weights)
        return Built(_compiled(self._openvino, model, self._dtype), size, self._dtype)

    def _convert(self, network: nn.Module, samples: SomeTensors) -> Any:
        # Only C is fixed: frames may have another size than the samples.
        with torch.no_grad(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # from the tracer, and about argument checks
            model = self._openvino.convert_model(
                deepcopy(network),
                example_input=samples[0],
                input=[[-1, samples[0].shape[1], -1, -1]],
                extension=[self._pixel_shuffle()],
            )
        return model if self._nncf is None else self._quantised(model, samples, self._nncf)

    def _pixel_shuffle(self) -> Any:
        """Converts torch's `pixel_shuffle` to one operator, which keeps channels last, instead of a
        transposition between two changes of shape, which does not."""
        from openvino import opset13
        from openvino.frontend.pytorch import ConversionExtension

        def convert(node: Any) -> Any:
            factor = node.get_values_from_const_input(1)
            return opset13.depth_to_space(node.get_input(0), "depth_first", factor).outputs()

        return ConversionExtension("aten::pixel_shuffle", convert)

    def _channels_last(self, model: Any) -> Any:
        """`model` with pictures in and out channels last, what goes in of `_dtype`, as its
        convolutions have them: the CPU need not convert them."""
        preprocess, layout = self._openvino.preprocess, self._openvino.Layout
        outside = preprocess.PrePostProcessor(model)
        kind = self._openvino.Type.bf16 if self._half else self._openvino.Type.f32
        for end in (outside.input(), outside.output()):
            end.tensor().set_layout(layout("NHWC"))
            end.model().set_layout(layout("NCHW"))
        outside.input().tensor().set_element_type(kind)
        return outside.build()

    def _quantised(self, model: Any, samples: SomeTensors, nncf: Any) -> Any:
        logging.getLogger("nncf").setLevel(logging.ERROR)
        frames = nncf.Dataset(samples, Tensor.numpy)
        options = {
            "preset": nncf.QuantizationPreset.MIXED,  # activations are not symmetric
            "subset_size": len(samples),
        }
        if self.uncalibrated:
            plain = nncf.AdvancedQuantizationParameters(disable_bias_correction=True)
            options["ignored_scope"] = nncf.IgnoredScope(types=list(NO_PRODUCTS), validate=False)
            options["advanced_parameters"] = plain
        with contextlib.redirect_stdout(sys.stderr):  # its progress bars
            quantised = nncf.quantize(model, frames, **options)
        if self.uncalibrated:
            _fix_ranges(quantised)
        return quantised


def _fix_ranges(model: Any) -> None:
    """Replace the ranges on which `model` rounds activations by those of `engines.largest`."""
    from openvino import opset13

    for op in model.get_ops():
        if op.get_type_name() != "FakeQuantize":
            continue
        maker = op.input_value(0).get_node().get_type_name()
        most = engines.largest(None if maker == "Parameter" else maker)
        bounds = (np.float32(-most * 128 / 127), np.float32(most))
        for place, bound in enumerate(2 * bounds, start=1):  # ranges of input and output
            op.input(place).replace_source_output(opset13.constant(bound).output(0))


def _capabilities(openvino: Any) -> list[str]:
    return openvino.Core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")


def _compiled(openvino: Any, model: Any, dtype: torch.dtype) -> Callable[[Tensor], Tensor]:
    """A model compiled for pictures of any size: to compile it for each size gains little, and each
    compilation holds its own memory."""
    half = dtype == torch.bfloat16
    settings = {
        "INFERENCE_PRECISION_HINT": "bf16" if half else "f32",
        "PERFORMANCE_HINT": "LATENCY",
        "INFERENCE_NUM_THREADS": torch.get_num_threads(),
    }
    kind = openvino.Type.bf16 if half else openvino.Type.f32
    request = openvino.Core().compile_model(model, "CPU", settings).create_infer_request()

    def run(picture: Tensor) -> Tensor:
        x = picture.movedim(1, -1).to(dtype).contiguous()
        bits = x.view(torch.int16) if half else x  # numpy has no bfloat16; the memory is the same
        given = openvino.Tensor(bits.numpy(), list(x.shape), kind)
        found = request.infer([given], share_inputs=True, share_outputs=True)
        return torch.from_numpy(found[0]).movedim(-1, 1)

    return run
