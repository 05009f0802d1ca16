"""ONNX Runtime as an engine: fp32, and int8 by its own static quantisation."""

from __future__ import annotations

import torch
from torch import Tensor

from bench.errors import Unavailable
from bench.types import Log
from methods.engines import (
    Built,
    Calibration,
    Engine,
    Folder,
    Inputs,
    Network,
    Precision,
    Samples,
    onnx_model,
    required,
)


class OnnxRuntime(Engine):
    """ONNX Runtime on the CPU. With int8, everything not quantised is computed in float32.

    Raises:
        Unavailable: ONNX Runtime or onnx is not installed.
    """

    name = "onnxruntime"
    precisions = ("fp32", "int8")
    libraries = ("onnx", "onnxruntime")
    prepares_sizes = False

    def __init__(self, precision: Precision = "fp32", calibration: Calibration = "frames") -> None:
        super().__init__(precision, calibration)
        _, self._runtime = (required(self.name, library, "onnx") for library in self.libraries)
        self._runtime.disable_telemetry_events()

    def check(self, device: torch.device) -> None:
        """See `Engine.check`."""
        super().check(device)
        if self.uncalibrated:
            raise Unavailable(
                "calibration=none: engine=onnxruntime would multiply in float32, because it "
                "multiplies 8-bit integers only where their sums are rounded, too: use "
                "engine=openvino"
            )

    def build(self, network: Network, samples: Samples, folder: Folder, log: Log) -> Built:
        """See `Engine.build`."""
        path = onnx_model.kept(network, samples, folder, self, log)
        options = self._runtime.SessionOptions()
        options.intra_op_num_threads = torch.get_num_threads()
        session = self._runtime.InferenceSession(path, options, ["CPUExecutionProvider"])
        names = onnx_model.input_names(network)

        def run(*inputs: Tensor) -> Inputs:
            arrays = {name: x.numpy() for name, x in zip(names, inputs, strict=True)}
            return tuple(torch.from_numpy(x) for x in session.run(None, arrays))

        return Built(run, onnx_model.weight_bytes(path))
