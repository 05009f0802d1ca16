"""The step of a ray that suits a training."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bench.types import Budget
from methods.instant_ngp.training import SamplingOptions
from methods.rendering.occupancy import RESOLUTION, STEP
from methods.rendering.sampling import suitable_step

BUDGET = Budget("test", steps=20_000, samples=1, renderer_steps=1)


def test_a_training_as_long_as_the_releases_has_its_step() -> None:
    assert SamplingOptions().sampling(BUDGET).step == STEP


def test_eight_times_the_steps_are_half_as_long() -> None:
    assert suitable_step(1000) / suitable_step(8000) == pytest.approx(2)


def test_it_is_no_longer_than_a_cell() -> None:
    assert suitable_step(1) == 1 / RESOLUTION


def test_a_training_takes_the_step_that_it_is_told() -> None:
    told = SamplingOptions(march_step=3.0)
    assert told.sampling(BUDGET) == told.sampling(replace(BUDGET, steps=5))
    assert told.sampling(BUDGET).step == 3 * STEP


def test_a_step_that_leads_nowhere_is_refused() -> None:
    with pytest.raises(ValueError, match="march_step: expected a length of more than 0"):
        SamplingOptions(march_step=0.0)
