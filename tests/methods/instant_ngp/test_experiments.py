"""The experiments on number formats: each format within what its digits allow."""

from __future__ import annotations

import pytest

from bench.case import U16, U32
from methods.instant_ngp.experiments import GRID, experiments

TABLE, NETWORKS = (
    "encoding: features, entries of -1 to 1",
    ("field: log density", "field: features"),
)


@pytest.fixture(scope="module")
def errors() -> dict[tuple[str, str], float]:
    """Largest error by subject and format."""
    return {
        (experiment.subject, str(trial.setting)): (
            (trial.call().double() - trial.exact).abs().max().item()
        )
        for experiment in experiments()
        for trial in experiment.trials
    }


def test_a_packed_table_loses_what_rounding_to_bf16_twice_does(errors):
    # Entries and features of at most 1, each rounded to 8 bits; and what float32 loses.
    assert 2**-10 < errors[TABLE, "packed bf16"] <= U16 + errors[TABLE, "float32"]


def test_a_table_in_float32_loses_what_positions_between_its_vertices_do(errors):
    # A coordinate of up to n_max is rounded thrice, and along each of three axes a feature changes
    # by up to 2 from vertex to vertex.
    assert errors[TABLE, "float32"] <= 3 * 2 * 3 * GRID.n_max * U32


@pytest.mark.parametrize("subject", NETWORKS)
def test_networks_in_bf16_are_worse_by_the_digits_they_lack(errors, subject):
    assert 10 * errors[subject, "float32"] < errors[subject, "bf16"] < 5 * U16
