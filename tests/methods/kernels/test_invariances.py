"""What changes nothing, or changes it in a known way, for any rays and any motion."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench.case import U32
from bench.cases import MOTION_UNITS, motion_error
from methods.kernels.composite.cases import CHANGES, change_error, random_rays

SEEDS = st.integers(0, 2**32 - 1)
BACKENDS = ("reference", "cpu")


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change[0])
@given(seed=SEEDS, rays=st.integers(1, 12), most=st.integers(1, 64))
def test_pixels_under_a_change(change: tuple, backend: str, seed: int, rays: int, most: int):
    _, changed, *_, cells = change
    error = change_error(changed, random_rays(seed, rays, most), backend, "cpu")
    assert error <= cells[backend, "fp32"]


@given(SEEDS)
def test_a_rigid_motion_of_scene_and_camera_moves_no_pixel(seed: int) -> None:
    assert motion_error(seed, "cpu") <= MOTION_UNITS * U32
