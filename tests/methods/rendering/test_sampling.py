"""How rays are sampled: the step that suits a training, and what is faint."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.types import Budget
from methods.instant_ngp.training import TrainingOptions
from methods.rendering.occupancy import RESOLUTION, STEP
from methods.rendering.sampling import FAINT, Sampling, suitable_step

BUDGET = Budget("test", steps=20_000, samples=1)


def test_a_training_as_long_as_the_releases_has_its_step() -> None:
    assert TrainingOptions().sampling(BUDGET).step == STEP
    assert suitable_step(1000) / suitable_step(8000) == pytest.approx(2)
    assert suitable_step(1) == 1 / RESOLUTION  # no longer than a cell


def test_a_training_takes_the_step_that_it_is_given() -> None:
    given = TrainingOptions(march_step=3.0)
    assert given.sampling(BUDGET) == given.sampling(replace(BUDGET, steps=5))
    assert given.sampling(BUDGET).step == 3 * STEP


def test_a_weight_is_faint_below_a_share_of_the_transmittance_at_the_end() -> None:
    assert Sampling(stop=0.01).least_weight == FAINT * 0.01
