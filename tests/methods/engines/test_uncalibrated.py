"""int8 without calibration: activations on fixed ranges, weights as ever, no frame for it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from methods.engines import CALIBRATION, Engine
from methods.engines.openvino_engine import OpenVino
from methods.engines.tensorrt_engine import TensorRt
from tests.common import seeded
from tests.methods.engines.test_engines import CPU, unet
from tests.methods.engines.test_tensorrt import graph_of

Kind = Callable[[str, str], Engine]

pytestmark = [
    pytest.mark.usefixtures("double", "no_bfloat16"),
    pytest.mark.parametrize("kind", [OpenVino, TensorRt]),
]


class Layers(nn.Module):
    """Two convolutions, and one of what is pooled between them, side by side. Weights are so large
    that what they make leaves its range, too."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        self.first, self.second = nn.Conv2d(4, 8, 3, padding=1), nn.Conv2d(8, 3, 3, padding=1)
        self.pooled = nn.Conv2d(8, 12, 1)
        self.requires_grad_(False).first.weight.mul_(2)

    def forward(self, x):
        between = self.first(x).relu()
        pooled = self.pooled(functional.max_pool2d(between, 2))
        return torch.cat((self.second(between), functional.pixel_shuffle(pooled, 2)), dim=1)


@pytest.fixture
def no_bfloat16(monkeypatch) -> None:
    """OpenVINO computes in float32 what it does not quantise, on any CPU."""
    monkeypatch.setattr("methods.engines.openvino_engine._capabilities", lambda openvino: [])


def noise(seed: int) -> Tensor:
    return torch.randn(1, 4, 8, 8, generator=seeded(seed))


def rounded(x: Tensor, largest: float) -> Tensor:
    """As 8-bit integers hold it, in steps of `largest` / 127."""
    return (x * 127 / largest).round().clamp(-128, 127) * largest / 127


def weights(kind: Kind, folder: Path) -> dict[tuple[int, ...], tuple[np.ndarray, np.ndarray]]:
    """The 8-bit weights that are convolved with, and their scales, by shape."""
    if kind is OpenVino:
        model = OpenVino().import_library("openvino").Core().read_model(folder / "network.xml")
        convolved = [op for op in model.get_ordered_ops() if op.get_type_name() == "Convolution"]
        kernels = [op.input_value(1).get_node() for op in convolved]
        pairs = [(k.input_value(0).get_node().input_value(0), k.input_value(1)) for k in kernels]
        found = [[x.get_node().data for x in pair] for pair in pairs]
    else:
        nodes, values = graph_of(folder)
        makers = {name: node for node in nodes for name in node.output}
        kernels = [makers[node.input[1]] for node in nodes if node.op_type == "Conv"]
        found = [[values[name] for name in kernel.input[:2]] for kernel in kernels]
    return {q.shape: (q, scale) for q, scale in found}


def adds_products_exactly() -> bool:
    """Whether the CPU adds 8-bit products in 32 bits. OpenVINO without VNNI adds two of them in 16,
    which saturate where weights and activations are both large."""
    can = torch.cpu.get_capabilities()
    return any(can.get(name) for name in ("avx512_vnni", "avx_vnni", "amx_int8"))


def test_activations_are_rounded_on_the_ranges_of_trtexec(kind, build, tmp_path):
    if kind is OpenVino and not adds_products_exactly():
        pytest.skip("this CPU has no VNNI: sums of 8-bit products saturate")
    module, inputs = Layers(), 3 * noise(1)  # beyond all three ranges
    got = build(kind("int8", "none"), module, [noise(0)]).run(inputs).split(3, dim=1)
    found = [weights(kind, tmp_path)[layer.weight.shape] for layer in module.children()]
    first, second, pooled = (torch.from_numpy(q * scale.reshape(-1, 1, 1, 1)) for q, scale in found)
    x = rounded(inputs, 2)
    between = functional.conv2d(x, first, module.first.bias, padding=1).relu()
    assert between.max() > 4
    want = functional.conv2d(rounded(between, 4), second, module.second.bias, padding=1)
    # Sums in another order turn a few numbers that lie between two integers.
    assert (got[0] - want).abs().median() < 1e-5
    assert (got[0] - want).abs().max() < 4 / 127
    inside = functional.max_pool2d(between, 2)
    assert inside.max() > 4
    want = functional.conv2d(rounded(inside, 2), pooled, module.pooled.bias)
    want = functional.pixel_shuffle(want, 2)
    # What is pooled may have been rounded on [-4, 4] before: half a step there, half a step here.
    step = pooled.abs().sum((1, 2, 3)).max() * (4 + 2) / 127 / 2
    assert (got[1] - want).abs().max() < step + 1e-5


def test_weights_are_those_of_int8_on_frames(kind, build, tmp_path):
    found = {}
    for calibration in ("frames", "none"):
        build(kind("int8", calibration), Layers(), [noise(0)], calibration)
        found[calibration] = weights(kind, tmp_path / calibration)
    for layer in Layers().children():
        q, scale = found["none"][layer.weight.shape]
        assert all(map(np.array_equal, (q, scale), found["frames"][layer.weight.shape]))
        if kind is TensorRt:  # every channel is scaled by its largest weight
            largest = layer.weight.abs().amax((1, 2, 3)).numpy()
            assert np.allclose(127 * scale, largest, rtol=1e-6)
            assert (np.abs(q.astype(int)).reshape(len(q), -1).max(1) == 127).all()


def test_no_number_of_a_frame_is_read(kind, build):
    samples = {"once": noise(0), "again": 9 * noise(1)}
    once, again = (
        build(kind("int8", "none"), Layers(), [some], folder).run(noise(2))
        for folder, some in samples.items()
    )
    assert torch.equal(once, again)


def test_networks_are_computed_within_half_a_step(kind, build):
    module, inputs = unet()
    got = build(kind("int8", "none"), module, inputs[:1]).run(inputs[0])
    assert (got - module(inputs[0])).square().mean().sqrt() < 4 / 127 / 2


def test_no_more_frames_are_needed_than_without_int8(kind):
    assert kind("int8", "none").samples == kind("fp32", "frames").samples == 1
    assert kind("int8", "frames").samples == CALIBRATION


def test_only_int8_depends_on_the_calibration(kind):
    assert kind("int8", "none").key() != kind("int8", "frames").key()
    assert kind("int8", "none").computed(CPU) == "int8 uncalibrated+fp32"
    assert kind("fp32", "none").key() == kind("fp32", "frames").key()
    assert kind("fp32", "none").computed(CPU) == "fp32"
