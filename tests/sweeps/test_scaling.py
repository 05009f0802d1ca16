"""`steerbench scaling`: the exponents it fits, and what it refuses before anything is trained."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.errors import SteerbenchError
from bench.types import Camera, Log
from sweeps.cli import dispatch
from sweeps.scaling import _render, growth
from tests.sweeps.stand_ins import Grey, white


@given(power=st.floats(-3, 3), factor=st.floats(1e-3, 1e3))
def test_the_exponent_of_a_power_is_found(power: float, factor: float) -> None:
    rows = [{"value": value, "ms": factor * value**power} for value in (1.0, 4.0, 9.0, 100.0)]
    assert growth(rows, "ms") == pytest.approx(power, abs=1e-9)


def test_a_value_of_0_is_left_out() -> None:
    rows = [{"value": value, "ms": 5.0 + value} for value in (0.0, 1.0, 7.0)]
    assert growth(rows, "ms") == pytest.approx(math.log(2) / math.log(7))


def test_a_single_value_has_no_exponent() -> None:
    assert math.isnan(growth([{"value": 2.0, "ms": 1.0}, {"value": 2.0, "ms": 2.0}], "ms"))


class Foreseeing(Grey):
    """Has a use for the next camera."""

    def foresee(self, camera: Camera) -> bool:
        return True


@pytest.mark.parametrize("lookahead", [False, True])
def test_latency_has_the_frame_before_where_the_next_camera_is_known(
    quiet_log: Log, lookahead: bool
) -> None:
    cameras = white(frames=4, log=quiet_log).splits["test"].cameras
    records, _ = _render(Foreseeing(0, "cpu", "none"), cameras, lookahead, quiet_log)
    assert len(records) == 4
    for before, record in pairwise(records):
        assert record.latency_ns == record.total_ns + lookahead * before.total_ns


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("method=ngp", "expected a method with a 2D renderer"),
        ("engine=openvino", "--axis threads: expected engine=torch"),
        ("--frames=0", "expected 1 or more, got 0"),
        ("--plot=picture.jpg", "ends in .png"),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once(argument: str, said: str) -> None:
    with pytest.raises(SteerbenchError, match=said):
        dispatch(["scaling", argument])
