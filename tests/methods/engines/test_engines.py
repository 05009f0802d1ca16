"""Engines: every one computes what the network does, as closely as its precision allows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from bench.console import ConsoleLog
from bench.errors import Unavailable
from methods.engines import Engine, Inputs, Network, noted_sizes, required
from methods.engines.openvino_engine import OpenVino, _capabilities
from methods.engines.torch_engine import TorchEngine
from methods.steernerf.unet import UNet
from methods.steernerf_lean.kernels.depthwise import neighbours_of
from tests.methods.observations import new_renderer, shaken

NO_BF16 = "BF16" not in _capabilities(required("openvino", "openvino", "openvino"))

ENGINES = [
    *((TorchEngine, p) for p in ("fp32", "bf16")),
    *((OpenVino, p) for p in ("fp32", "int8")),
    pytest.param(
        OpenVino, "bf16", marks=pytest.mark.skipif(NO_BF16, reason="no bfloat16 on this CPU")
    ),
]

TOLERANCE = {"fp32": 1e-5, "bf16": 0.03, "int8": 0.1}
"""Of the root mean square of the network's outputs. fp32: sums of a few hundred products in another
order. Below, a number is rounded by 2^-8 (bf16), or by half of 1/255 of the range that it
was seen in (int8), before each of half a dozen layers; single layers are kept higher."""


def cells(count: int, seed: int = 0) -> Inputs:
    """Rows and neighbours of `count` cells in a square."""
    renderer = new_renderer(width=64, blocks=6)
    generator = torch.Generator().manual_seed(seed)
    side = round(count**0.5)
    neighbours = neighbours_of(torch.ones(1, side, side, dtype=torch.bool))
    return torch.rand(side * side, renderer.layout.width, generator=generator) - 0.5, neighbours


def lean() -> tuple[Network, list[Inputs]]:
    """The lean network, and inputs of three sizes."""
    torch.manual_seed(1000)  # other numbers than those of the inputs
    renderer = shaken(new_renderer(width=64, blocks=6)).requires_grad_(False)
    return renderer.network, [cells(count, seed) for seed, count in enumerate((64, 100, 64, 144))]


def test_a_view_of_nothing_has_no_cells(folder: Callable[[], Path], quiet_log: ConsoleLog) -> None:
    module, inputs = lean()
    built = OpenVino("fp32").build(module, lambda: inputs, folder, quiet_log)
    for got, want in zip(built.run(*cells(0)), module(*cells(0)), strict=True):
        assert got.shape == want.shape == (0, got.shape[1])


def unet() -> tuple[Network, list[Inputs]]:
    torch.manual_seed(1000)
    renderer = shaken(UNet(6, 1, 4, width=64, aligned=False)).requires_grad_(False)
    generator = torch.Generator().manual_seed(0)
    return renderer.network, [(torch.rand(1, 12, 36, 44, generator=generator),) for _ in range(3)]


def assert_close(got: Inputs, want: Inputs, precision: str) -> None:
    for some, exact in zip(got, want, strict=True):
        assert some.shape == exact.shape
        error = (some.float() - exact).square().mean().sqrt()
        assert error < TOLERANCE[precision] * exact.square().mean().sqrt()


@pytest.mark.parametrize(("kind", "precision"), ENGINES)
@pytest.mark.parametrize("network", [lean, unet])
def test_an_engine_computes_what_the_network_does(
    kind: Callable[[str], Engine],
    precision: str,
    network: Callable[[], tuple[Network, list[Inputs]]],
    folder: Callable[[], Path],
    quiet_log: ConsoleLog,
) -> None:
    module, inputs = network()
    built = kind(precision).build(module, lambda: inputs, folder, quiet_log)
    with torch.no_grad():
        for some in inputs:
            assert_close(built.run(*some), module(*some), precision)


@pytest.mark.parametrize("precision", ["fp32", "int8"])
def test_pictures_may_differ_in_size_from_the_samples_and_from_one_another(
    precision: str, folder: Callable[[], Path], quiet_log: ConsoleLog
) -> None:
    module, ((picture,), *_) = unet()
    samples = [(picture,), (picture[..., :32, :40],)]
    for _ in range(2):  # built, and found again
        built = OpenVino(precision).build(module, lambda: samples, folder, quiet_log)
        for size in ((36, 44), (30, 41), (36, 24)):
            cropped = picture[..., : size[0], : size[1]]
            with torch.no_grad():
                assert_close(built.run(cropped), module(cropped), precision)


def test_int8_weights_take_a_quarter(tmp_path: Path, quiet_log: ConsoleLog) -> None:
    module, inputs = unet()
    sizes = {}
    for precision in ("fp32", "int8"):
        folder = tmp_path / precision
        folder.mkdir()
        built = OpenVino(precision).build(module, lambda: inputs, lambda at=folder: at, quiet_log)
        sizes[precision] = built.size
    exact = 4 * sum(weight.numel() for weight in module.parameters())
    assert exact <= sizes["fp32"] < 1.01 * exact  # and a few sizes and shapes
    assert 0.25 * exact <= sizes["int8"] < 0.27 * exact  # biases and scales stay as they are


@pytest.mark.slow
def test_what_was_built_is_found_again(folder: Callable[[], Path], quiet_log: ConsoleLog) -> None:
    module, inputs = lean()
    first = OpenVino("int8").build(module, lambda: inputs, folder, quiet_log)
    before = {path.name for path in folder().iterdir()}

    def never() -> list[Inputs]:
        raise AssertionError("the frames are not needed again")

    again = OpenVino("int8").build(module, never, folder, quiet_log)
    for got, want in zip(again.run(*inputs[0]), first.run(*inputs[0]), strict=True):
        assert torch.equal(got, want)
    assert {path.name for path in folder().iterdir()} == before
    assert not any(path.is_dir() for path in folder().iterdir())  # it was built in one


def test_a_precision_that_an_engine_does_not_have_is_refused_by_name() -> None:
    with pytest.raises(Unavailable, match="expected one of fp32, bf16, int8, which engine=openv"):
        OpenVino("fp16")


def test_openvino_refuses_a_bfloat16_that_it_would_compute_in_float32(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        "methods.engines.openvino_engine._capabilities", lambda openvino: ["FP32", "INT8"]
    )
    with pytest.raises(Unavailable, match="openvino has no bfloat16 on this CPU, use precision=f"):
        OpenVino("bf16")


@pytest.mark.parametrize(("capabilities", "rest"), [(["BF16", "INT8"], "bf16"), (["INT8"], "fp32")])
def test_rows_say_what_openvino_computes_beside_int8(
    capabilities: list[str], rest: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "methods.engines.openvino_engine._capabilities", lambda openvino: capabilities
    )
    cpu = torch.device("cpu")
    assert OpenVino("int8").computed(cpu) == f"int8+{rest}"
    assert OpenVino("int8", "none").computed(cpu) == f"int8 uncalibrated+{rest}"
    assert OpenVino("fp32", "none").computed(cpu) == "fp32"


@pytest.mark.parametrize(("products", "computed"), [(True, "bf16"), (False, "bf16 in fp32")])
def test_rows_say_what_torch_multiplies_in_bfloat16(
    products: bool, computed: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("methods.engines.torch_engine.multiplies_bf16", lambda kind: products)
    assert TorchEngine("bf16").computed(torch.device("cpu")) == computed
    assert TorchEngine("fp32").computed(torch.device("cpu")) == "fp32"


def test_half_precision_without_a_gpu_is_refused() -> None:
    with pytest.raises(Unavailable, match="on a CPU use bf16"):
        TorchEngine("fp16").check(torch.device("cpu"))


def test_a_library_that_is_missing_is_named_with_the_command_that_installs_it() -> None:
    with pytest.raises(Unavailable, match=r'engine=ours .*pip install .*"\.\[extra\]"'):
        required("ours", "nowhere", "extra")


def test_sizes_that_may_come_are_compiled_before_a_frame_is_timed(
    folder: Callable[[], Path], quiet_log: ConsoleLog
) -> None:
    module, _ = lean()
    quantum = module.quantum
    rows, neighbours = cells(0)
    some = rows.new_zeros(2 * quantum, rows.shape[1]), neighbours.new_zeros(2 * quantum, 9)
    OpenVino("fp32").build(module, lambda: [some], folder, quiet_log)
    assert noted_sizes(folder() / "network.xml") == [quantum, 2 * quantum, 3 * quantum]
