"""The hash-grid field."""

from __future__ import annotations

import torch

from methods.fields import HashField
from methods.kernels.encode import HashGrid

GRID = HashGrid(levels=4, log2_table=8, n_min=4, n_max=32)


def field(precision: str, **options) -> HashField:
    made = HashField(
        GRID, precision=precision, generator=torch.Generator().manual_seed(0), **options
    )
    with torch.no_grad():
        made.table.mul_(1e4)  # from +-1e-4 to +-1, so that outputs differ
    made.repack()
    return made


def evaluate(made: HashField) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    positions = torch.rand(200, 3, generator=generator)
    directions = made.encode_directions(torch.randn(200, 3, generator=generator))
    sigma, geometry = made.density(positions)
    return sigma, made.features(geometry, directions)


def test_density_is_positive_and_features_are_in_the_unit_interval() -> None:
    sigma, features = evaluate(field("bf16", channels=6))
    assert sigma.dtype == features.dtype == torch.float32
    assert features.shape == (200, 6)
    assert (sigma > 0).all()
    assert ((features > 0) & (features < 1)).all()


def test_bfloat16_is_close_to_float32() -> None:
    exact, rounded = evaluate(field("fp32")), evaluate(field("bf16"))
    # Five layers and the table, each rounded to a relative 2^-9 of values that cancel in sums.
    torch.testing.assert_close(rounded[1], exact[1], rtol=0, atol=0.03)
    torch.testing.assert_close(rounded[0].log(), exact[0].log(), rtol=0, atol=0.1)


def test_fp32_agrees_between_backends() -> None:
    reference, fast = field("fp32", backend="reference"), field("fp32", backend="cpu")
    for got, want in zip(evaluate(fast), evaluate(reference), strict=True):
        torch.testing.assert_close(got, want, rtol=1e-4, atol=1e-4)


def test_sizes_are_those_of_the_precision() -> None:
    networks = 8 * 64 + 64 * 16 + 32 * 64 + 64 * 64 + 64 * 3
    assert field("bf16").sizes() == {
        "hash_table": GRID.entries * 2 * 2,
        "field_networks": networks * 2,
    }
    assert field("fp32").sizes()["field_networks"] == networks * 4


def test_the_gradient_of_a_huge_density_is_clamped() -> None:
    from methods.fields import LOG_DENSITY_CLAMP, _ClampedExp

    log_density = torch.tensor([-100.0, 0.0, 30.0], requires_grad=True)
    sigma = _ClampedExp.apply(log_density)
    sigma.sum().backward()
    edge = torch.tensor(LOG_DENSITY_CLAMP).exp()
    assert log_density.grad is not None
    torch.testing.assert_close(log_density.grad, torch.stack((1 / edge, edge / edge, edge)))
