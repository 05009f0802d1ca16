"""`steerbench scaling`: the exponents it fits, and what it refuses before anything is trained."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.errors import SteerbenchError
from sweeps.cli import dispatch
from sweeps.commands.scaling import growth


@given(power=st.floats(-3, 3), factor=st.floats(1e-3, 1e3))
def test_the_exponent_of_a_power_is_found(power, factor):
    rows = [{"value": value, "ms": factor * value**power} for value in (1.0, 4.0, 9.0, 100.0)]
    assert growth(rows, "ms") == pytest.approx(power, abs=1e-9)


def test_a_value_of_0_is_left_out_and_a_single_one_has_no_exponent():
    rows = [{"value": value, "ms": 5.0 + value} for value in (0.0, 1.0, 7.0)]
    assert growth(rows, "ms") == pytest.approx(math.log(2) / math.log(7))
    assert math.isnan(growth([{"value": 2.0, "ms": 1.0}, {"value": 2.0, "ms": 2.0}], "ms"))


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("engine=openvino", "--axis threads: expected engine=torch"),
        ("--axis=width", "unknown axis 'width'"),
        ("--frames=0", "expected 1 or more, got 0"),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once(argument, said):
    with pytest.raises(SteerbenchError, match=said):
        dispatch(["scaling", argument])
