"""Gaussians in few bytes: how far values move, and how many bytes they take."""

from methods.gaussians.model import rounded, stored_bytes
from tests.methods.gaussians.test_ply import some


def test_values_move_by_half_a_level_at_most():
    given = some(500)
    given.log_scales.data[:, 2] = -3.0  # equal values stay as they are
    found = rounded(given)
    for name, levels in (("means", 2**16), ("log_scales", 2**8), ("opacities", 2**8)):
        old, new = getattr(given, name), getattr(found, name)
        step = (old.amax(dim=0) - old.amin(dim=0)) / (levels - 1)
        # A tenth of a level more, for roundings of the levels themselves.
        assert ((old - new).abs() <= 0.6 * step).all()
        assert len(new.view(500, -1)[:, 0].unique()) <= levels


def test_a_gaussian_of_degree_3_takes_62_bytes():
    # 3 x 2 of its mean, 3 of scales, 4 of the rotation, 1 of the opacity, 48 of colours.
    extremes = 8 * (3 + 3 + 4 + 1 + 48)
    assert stored_bytes(some(10)) == 10 * 62 + extremes
