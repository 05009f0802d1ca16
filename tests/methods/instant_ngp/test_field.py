"""The hash-grid field."""

from __future__ import annotations

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from methods.instant_ngp.field import HashField
from methods.kernels.encode import HashGrid, encode
from tests.methods.conftest import Work

GRID = HashGrid(levels=4, log2_table=8, n_min=4, n_max=32)
GENERATOR = torch.Generator().manual_seed(1)
POSITIONS = torch.rand(200, 3, generator=GENERATOR)
DIRECTIONS = torch.randn(200, 3, generator=GENERATOR)


def field(precision: str, **options) -> HashField:
    made = HashField(
        GRID, precision=precision, generator=torch.Generator().manual_seed(0), **options
    )
    with torch.no_grad():
        made.table.mul_(1e4)  # from +-1e-4 to +-1, so that outputs differ
    made.repack()
    return made


def evaluate(made: HashField) -> tuple[torch.Tensor, torch.Tensor]:
    directions = made.encode_directions(DIRECTIONS)
    sigma, geometry = made.density(POSITIONS)
    return sigma, made.features(geometry, directions)


def test_density_is_positive_and_features_are_in_the_unit_interval() -> None:
    sigma, features = evaluate(field("bf16", channels=6))
    assert sigma.dtype == features.dtype == torch.float32
    assert features.shape == (200, 6)
    assert (sigma > 0).all()
    assert ((features > 0) & (features < 1)).all()


def test_bfloat16_is_close_to_float32() -> None:
    exact, rounded = evaluate(field("fp32")), evaluate(field("bf16"))
    # Five layers and the table, each rounded to a relative 2^-8 of values that cancel in sums.
    torch.testing.assert_close(rounded[1], exact[1], rtol=0, atol=0.03)
    torch.testing.assert_close(rounded[0].log(), exact[0].log(), rtol=0, atol=0.1)


def test_fp32_agrees_between_backends() -> None:
    reference, fast = field("fp32", backend="reference"), field("fp32", backend="cpu")
    for got, want in zip(evaluate(fast), evaluate(reference), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


def test_without_products_of_bfloat16_what_is_stored_in_it_is_multiplied_in_float32(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("methods.instant_ngp.field.multiplies_bf16", lambda kind: False)
    rounded, stored = field("bf16"), field("fp32")
    with torch.no_grad():
        for parameter in stored.parameters():
            parameter.copy_(parameter.bfloat16())
    encoded = encode(POSITIONS, rounded.table, GRID, packed=rounded.packed).double()
    layers = {name: weights.double() for name, weights in stored.layers.items()}
    hidden = (encoded @ layers["density_in"].T).relu()
    log_density = (hidden @ layers["density_out"].T)[:, 0]
    # Sums of at most 64 products: 64 u = 4e-6 of the largest, which is some units.
    torch.testing.assert_close(
        rounded.density(POSITIONS)[0].log().double(), log_density, rtol=0, atol=2e-5
    )


def test_sizes_are_those_of_the_precision() -> None:
    networks = 8 * 64 + 64 * 16 + 32 * 64 + 64 * 64 + 64 * 3
    assert field("bf16").sizes() == {
        "hash_table": GRID.entries * 2 * 2,
        "field_networks": networks * 2,
    }
    assert field("fp32").sizes()["field_networks"] == networks * 4


def test_the_gradient_of_a_huge_density_is_clamped() -> None:
    from methods.instant_ngp.field import LOG_DENSITY_CLAMP, _ClampedExp

    log_density = torch.tensor([-100.0, 0.0, 30.0], requires_grad=True)
    sigma = _ClampedExp.apply(log_density)
    sigma.sum().backward()
    edge = torch.tensor(LOG_DENSITY_CLAMP).exp()
    assert log_density.grad is not None
    torch.testing.assert_close(log_density.grad, torch.stack((1 / edge, edge / edge, edge)))


@pytest.mark.parametrize("levels", [1, 3, 4])
def test_the_work_of_a_field_is_what_torch_counts(levels: int) -> None:
    made, work = field("fp32", channels=6).coarse(levels), Work()
    made.count(work, 200, 200)
    with FlopCounterMode(display=False) as counter:
        evaluate(made)
    assert 2 * work.done["products"] == counter.get_total_flops()
    assert work.done["table_reads"] == 200 * levels * 8


@pytest.mark.parametrize("precision", ["bf16", "fp32"])
def test_a_coarse_field_is_one_whose_finer_levels_hold_nothing(precision: str) -> None:
    whole, emptied = field(precision), field(precision)
    with torch.no_grad():
        emptied.table[GRID.offsets[2] :] = 0
    emptied.repack()
    for got, want in zip(evaluate(whole.coarse(2)), evaluate(emptied), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-6)


def test_what_a_coarse_field_learns_the_field_has_learned() -> None:
    whole = field("fp32")
    coarse = whole.coarse(2)
    sigma, features = evaluate(coarse)
    (sigma.sum() + features.sum()).backward()
    assert coarse.table is whole.table
    gradient = whole.table.grad
    assert gradient is not None
    assert gradient[: GRID.offsets[2]].any()
    assert not gradient[GRID.offsets[2] :].any()
    whole.widen(6)
    assert coarse.layers["feature_out"] is whole.layers["feature_out"]
