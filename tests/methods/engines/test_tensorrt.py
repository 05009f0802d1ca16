"""TensorRT as an engine, without a GPU: what it gets, and what is kept of what it builds.

What TensorRT itself makes of the models is not tested here; see `tensorrt_double`.
"""

import math
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from bench.errors import Unavailable
from methods.engines.tensorrt_engine import TensorRt
from tests.common import refusal
from tests.methods.engines import tensorrt_double
from tests.methods.engines.test_engines import TOLERANCE, assert_close, unet


@pytest.mark.parametrize("precision", TensorRt.precisions)
def test_pictures_of_each_size_have_a_plan_which_is_found_again(precision, double, tmp_path, build):
    module, (picture, *_) = unet()
    crops = [picture[..., :height, :width] for height, width in ((36, 44), (28, 40), (36, 24))]
    # The tolerance is of half a dozen layers; the U-Net has 19, whose roundings add up as their
    # square root.
    tolerance = math.sqrt(19 / 6) * TOLERANCE.get(precision, 2**-8)
    for samples in ([picture], None):
        built = build(TensorRt(precision), module, samples)
        for crop in 2 * crops:
            got = built.run(crop)
            assert got.dtype == torch.float32
            assert_close(got, module(crop), tolerance)
    assert tensorrt_double.Builder.built == 3
    plans = {path.name for path in tmp_path.glob("*.plan")}
    assert plans == {f"1x12x{size}.plan" for size in ("36x44", "28x40", "36x24")}


def graph_of(folder: Path) -> tuple[list[onnx.NodeProto], dict[str, np.ndarray]]:
    """The nodes and the constants of the model in a folder."""
    graph = onnx.load(folder / "network.onnx").graph
    return graph.node, {x.name: onnx.numpy_helper.to_array(x) for x in graph.initializer}


def test_int8_is_symmetric_with_biases_in_float32(double, tmp_path, build):
    build(TensorRt("int8"), *unet())
    nodes, values = graph_of(tmp_path)
    pairs = [n for n in nodes if n.op_type in ("QuantizeLinear", "DequantizeLinear")]
    assert pairs
    assert not any(np.any(values[node.input[2]]) for node in pairs)
    biases = [name for node in nodes if node.op_type == "Conv" for name in node.input[2:]]
    assert biases
    assert all(values[bias].dtype == np.float32 for bias in biases)


def test_float32_is_not_computed_in_tf32(double, build, monkeypatch):
    cleared = []
    clear = "tests.methods.engines.tensorrt_double.Builder.clear_flag"
    monkeypatch.setattr(clear, lambda config, flag: cleared.append((precision, flag)))
    for precision in TensorRt.precisions:
        network, inputs = unet()
        build(TensorRt(precision), network, inputs, precision).run(inputs[0])
    tf32 = tensorrt_double.BuilderFlag.TF32
    assert cleared == [("fp32", tf32), ("int8", tf32)]  # int8: of what is not quantised


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        ("OnnxParser.parse_from_file", r"TensorRT 11\.4\.0 cannot read .*no such operator"),
        ("Builder.build_serialized_network", r"cannot build .* for 1x12x36x44; it says"),
        ("Runtime.deserialize_cuda_engine", r"cannot load its plan: remove .*\.plan"),
        ("CudaEngine.execute_async_v3", r"cannot run a network on \[1, 12, 36, 44\]; it says why"),
    ],
)
def test_what_tensorrt_refuses_is_said(broken, message, double, tmp_path, build, monkeypatch):
    monkeypatch.setattr(f"tests.methods.engines.tensorrt_double.{broken}", lambda *arguments: None)
    network, inputs = unet()
    built = build(TensorRt("fp32"), network, inputs)
    with refusal(message):
        built.run(inputs[0])
    kept = broken.startswith(("Runtime", "CudaEngine"))
    assert len(list(tmp_path.glob("*.plan"))) == kept


def test_a_build_belongs_to_its_gpu_and_version(double, monkeypatch):
    versions = {"tensorrt": "11.4.0"}
    monkeypatch.setattr("bench.provenance._version", lambda name: versions.get(name, "1.0"))
    first = TensorRt("fp16").key()
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda: "another GPU")
    second = TensorRt("fp16").key()
    versions["tensorrt"] = "12.0"
    assert len({str(key) for key in (first, second, TensorRt("fp16").key())}) == 3


@pytest.mark.parametrize("device", ["cpu", "cuda:1"])
def test_what_is_not_the_first_gpu_is_refused(device, double):
    with refusal(f"this is device={device}: use device=cuda", Unavailable):
        TensorRt("fp16").check(torch.device(device))


@pytest.mark.skipif(torch.cuda.is_available(), reason="for a machine without a GPU")
def test_without_a_gpu_that_is_the_reason_and_not_a_library():
    with refusal("torch sees none here: use engine=openvino", Unavailable):
        TensorRt("fp16")


def test_without_tensorrt_the_command_that_installs_it_is_named(double, monkeypatch):
    monkeypatch.setitem(sys.modules, "tensorrt", None)
    with refusal(r'pip install .*"\.\[tensorrt\]"', Unavailable):
        TensorRt("fp16")
