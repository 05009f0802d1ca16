"""What changes nothing, for any motion."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from bench.case import U32
from bench.cases import MOTION_UNITS, motion_error

SEEDS = st.integers(0, 2**32 - 1)


@given(SEEDS)
def test_a_rigid_motion_of_scene_and_camera_moves_no_pixel(seed: int) -> None:
    assert motion_error(seed, "cpu") <= MOTION_UNITS * U32
