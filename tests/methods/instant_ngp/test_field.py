"""The hash-grid field."""

import math

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from methods.instant_ngp.field import LOG_DENSITY_CLAMP, HashField, _ClampedExp
from methods.kernels.encode import HashGrid, SampleGradients, encode
from tests.common import assert_near, seeded
from tests.methods.conftest import Work

GRID = HashGrid(levels=4, features=2, log2_table=8, n_min=4, n_max=32)
GENERATOR = seeded(1)
POSITIONS = torch.rand(200, 3, generator=GENERATOR)
DIRECTIONS = torch.randn(200, 3, generator=GENERATOR)


def field(precision: str, **options) -> HashField:
    made = HashField(GRID, precision=precision, generator=seeded(0), **options)
    with torch.no_grad():
        made.table.mul_(1e4)  # from +-1e-4 to +-1, so that outputs differ
    made.repack()
    return made


def evaluate(made: HashField) -> tuple[torch.Tensor, torch.Tensor]:
    directions = made.encode_directions(DIRECTIONS)
    sigma, geometry = made.density(POSITIONS)
    return sigma, made.features(geometry, directions)


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("collected", [False, True])
def test_a_known_encoding_changes_neither_density_nor_gradient(precision, collected):
    found = []
    for known in (False, True):
        made = field(precision)
        made.gradients = SampleGradients() if collected else None
        with torch.no_grad():
            encoded = made.encode(POSITIONS) if known else None
        sigma, _ = made.density(POSITIONS, encoded)
        sigma.sum().backward()
        grads = [made.layers["density_in"].grad, made.table.grad]
        if made.gradients is not None:
            grads += made.gradients.joined()
        found.append([sigma.detach(), *(grad for grad in grads if grad is not None)])
    for got, want in zip(*found, strict=True):
        assert want.any()
        assert torch.equal(got, want)


def test_bfloat16_is_close_to_float32():
    exact, rounded = evaluate(field("fp32")), evaluate(field("bf16"))
    # Five layers and the table, each rounded to a relative 2^-8 of values that cancel in sums.
    assert_near(rounded[1], exact[1], atol=0.03)
    assert_near(rounded[0].log(), exact[0].log(), atol=0.1)


def test_without_products_of_bfloat16_what_is_stored_in_it_is_multiplied_in_float32(monkeypatch):
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
    assert_near(rounded.density(POSITIONS)[0].log().double(), log_density, atol=2e-5)


def test_sizes_are_those_of_the_precision():
    networks = 8 * 64 + 64 * 16 + 32 * 64 + 64 * 64 + 64 * 3
    assert field("bf16").sizes() == {
        "hash_table": GRID.entries * 2 * 2,
        "field_networks": networks * 2,
    }
    assert field("fp32").sizes()["field_networks"] == networks * 4


def test_the_gradient_of_a_huge_density_is_clamped():
    log_density = torch.tensor([-100.0, 0.0, 30.0], requires_grad=True)
    sigma = _ClampedExp.apply(log_density)
    sigma.sum().backward()
    edge = torch.tensor(LOG_DENSITY_CLAMP).exp()
    torch.testing.assert_close(log_density.grad, torch.stack((1 / edge, edge / edge, edge)))


def test_the_work_of_a_field_is_what_torch_counts():
    made, work = field("fp32", channels=6, backend="reference"), Work()
    made.count(work, 200, 200)
    with FlopCounterMode(display=False) as counter:
        evaluate(made)
    assert 2 * work.done["products"] == counter.get_total_flops()
    assert work.done["table_reads"] == 200 * GRID.levels * 8


def test_features_that_are_appended_are_random():
    made = field("fp32")
    before = evaluate(made)
    made.widen(6, seeded(0))
    sigma, features = evaluate(made)
    assert made.channels == 6
    assert torch.equal(sigma, before[0])
    assert_near(features[:, :3], before[1], atol=1e-6)
    appended = made.layers["feature_out"].detach()[3:]
    # Xavier: uniform in +-sqrt(6 / (64 + 6)), 192 of them.
    assert 0.9 * math.sqrt(6 / 70) < appended.abs().max() < math.sqrt(6 / 70)
    assert (features[:, 3:].std(dim=0) > 0).all()
