"""Engines: every one computes what the network does, as closely as its precision allows."""

import pytest
import torch
from torch import Tensor, nn

from bench.errors import Unavailable
from methods.engines.openvino_engine import OpenVino, _capabilities
from methods.engines.torch_engine import TorchEngine
from methods.steernerf.unet import UNet
from tests.common import refusal, seeded
from tests.methods.models import shaken

needs_bf16 = pytest.mark.skipif(
    "BF16" not in _capabilities(OpenVino().import_library("openvino")),
    reason="no bfloat16 on this CPU",
)
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="for a machine with a GPU")
ENGINES = [
    *((TorchEngine, p, "cpu") for p in ("fp32", "bf16")),
    pytest.param(OpenVino, "bf16", "cpu", marks=needs_bf16),
    *(pytest.param(TorchEngine, p, "cuda", marks=needs_gpu) for p in TorchEngine.precisions),
]

TOLERANCE = {"fp32": 1e-5, "bf16": 0.03, "int8": 0.1}
"""Of the root mean square of the network's outputs. fp32: sums of a few hundred products in another
order. Below, a number is rounded by 2^-8 (bf16), or by half of 1/255 of the range that it
was seen in (int8), before each of half a dozen layers; single layers are kept higher."""

CPU = torch.device("cpu")


def unet() -> tuple[nn.Module, list[Tensor]]:
    """The U-Net, and inputs of one size."""
    torch.manual_seed(1000)
    renderer = shaken(UNet(6, 1, 4, width=64, aligned=False)).requires_grad_(False)
    return renderer.network, list(torch.rand(3, 1, 12, 36, 44, generator=seeded(0)))


def assert_close(got: Tensor, want: Tensor, tolerance: float) -> None:
    """Within `tolerance`, as a share of the root mean square."""
    assert got.shape == want.shape
    error = (got.cpu().float() - want).square().mean().sqrt()
    assert error < tolerance * want.square().mean().sqrt()


@pytest.mark.parametrize(("kind", "precision", "where"), ENGINES)
def test_an_engine_computes_what_the_network_does(kind, precision, where, build):
    network, inputs = unet()
    wanted, seen = [network(some) for some in inputs], [some.to(where) for some in inputs]
    built = build(kind(precision), network.to(where), seen)
    for some, want in zip(seen, wanted, strict=True):
        assert_close(built.run(some), want, TOLERANCE.get(precision, 0.03))


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_pictures_may_differ_in_size_from_the_samples_and_from_one_another(precision, build):
    """And are what the network computes."""
    network, (picture, *_) = unet()
    for _ in range(2):  # built, and found again
        built = build(OpenVino(precision), network, [picture, picture[..., :32, :40]])
        for height, width in ((36, 44), (28, 40), (36, 24)):
            cropped = picture[..., :height, :width]
            with torch.no_grad():
                assert_close(built.run(cropped), network(cropped), TOLERANCE[precision])


def test_int8_weights_take_a_quarter(build):
    network, inputs = unet()
    whole, quarter = (build(OpenVino(p), network, inputs, p).size for p in ("fp32", "int8"))
    exact = 4 * sum(weight.numel() for weight in network.parameters())
    assert exact <= whole < 1.01 * exact  # and a few sizes and shapes
    assert 0.25 * exact <= quarter < 0.27 * exact  # biases and scales stay as they are


def test_what_an_engine_lacks_is_refused_by_name(monkeypatch):
    with refusal("expected one of fp32, bf16, int8, which engine=openv", Unavailable):
        OpenVino("fp16")
    with refusal("on a CPU use bf16", Unavailable):
        TorchEngine("fp16").check(CPU)
    # It would compute in float32 without saying so.
    capabilities = "methods.engines.openvino_engine._capabilities"
    monkeypatch.setattr(capabilities, lambda openvino: ["FP32", "INT8"])
    with refusal("openvino has no bfloat16 on this CPU, use precision=f", Unavailable):
        OpenVino("bf16")


@pytest.mark.parametrize(("capabilities", "rest"), [(["BF16", "INT8"], "bf16"), (["INT8"], "fp32")])
def test_rows_say_what_openvino_computes_beside_int8(capabilities, rest, monkeypatch):
    monkeypatch.setattr(
        "methods.engines.openvino_engine._capabilities", lambda openvino: capabilities
    )
    assert OpenVino("int8").computed(CPU) == f"int8+{rest}"


@pytest.mark.parametrize(("products", "computed"), [(True, "bf16"), (False, "bf16 in fp32")])
def test_rows_say_what_torch_multiplies_in_bfloat16(products, computed, monkeypatch):
    monkeypatch.setattr("methods.engines.torch_engine.multiplies_bf16", lambda kind: products)
    assert TorchEngine("bf16").computed(CPU) == computed
    assert TorchEngine("fp32").computed(CPU) == "fp32"


def test_a_replay_gives_the_output_of_the_network_and_leaves_the_input_alone(gpu, build):
    network, pictures = unet()
    given = [picture for x in pictures for picture in (x, x[..., :28, :40].contiguous())]
    wanted = [network(picture) for picture in given]
    run = build(TorchEngine(), network.to("cuda"), pictures).run
    for picture, want in zip(given, wanted, strict=True):
        there = picture.cuda()
        assert torch.equal(run(there).cpu(), want)
        assert torch.equal(there.cpu(), picture)
    assert len(run._recordings) == 2  # sizes
