"""The reprojection experiments against closed forms."""

from __future__ import annotations

import pytest

from bench.accuracy import Experiment
from methods.steernerf.kernels.splat.experiments import BESIDE, WALL, experiments


@pytest.fixture(scope="module")
def by_knob() -> dict[str, list[Experiment]]:
    found: dict[str, list[Experiment]] = {}
    for experiment in experiments():
        found.setdefault(experiment.knob, []).append(experiment)
    return found


def errors(experiment: Experiment) -> dict[float, float]:
    return {
        float(trial.setting): (trial.call().double() - trial.exact).abs().max().item()
        for trial in experiment.trials
    }


def test_a_wrong_depth_looks_up_beside_by_the_difference_of_the_parallaxes(by_knob):
    (experiment,) = by_knob["relative error of the depth"]
    parallax = 256 * BESIDE / WALL
    for wrong, error in errors(experiment).items():
        # Coordinates up to 256 in float32, rounded a dozen times.
        assert error == pytest.approx(parallax * (1 - 1 / (1 + wrong)), abs=12 * 256 * 2**-24)


def test_a_splatted_pixel_shows_what_lies_within_half_a_pixel(by_knob):
    splatted, _ = by_knob["pixel, sides of the picture"]
    for pixel, error in errors(splatted).items():
        # The pattern changes by at most 3 pi along one axis, half of it along each at the steepest.
        assert pixel <= error <= 3 * 3.1416 * pixel


def test_a_pixel_looked_up_between_four_is_off_by_the_curvature(by_knob):
    _, warped = by_knob["pixel, sides of the picture"]
    for pixel, error in errors(warped).items():
        # h^2 / 8 times the second derivatives along both axes, (6 pi)^2 / 2 each.
        assert error <= pixel**2 / 8 * (6 * 3.1416) ** 2
