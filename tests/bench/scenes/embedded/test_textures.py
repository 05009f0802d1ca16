"""Noise, and patterns where they can be told beforehand."""

import torch

from bench.scenes.embedded.textures import checker, lattice, noise, pips, polar_checker, spiral
from tests.common import assert_near, seeded

DARK, LIGHT = (0.1, 0.1, 0.2), (0.7, 0.6, 0.5)


def test_noise_is_that_of_its_lattice_continuous_and_has_a_period():
    corners = torch.cartesian_prod(*3 * [torch.arange(4.0)])
    x, y, z = corners.long().unbind(1)
    # The first coordinate of `grid_sample` runs along the last axis.
    assert_near(noise(corners), lattice()[z, y, x], atol=1e-4)
    points = 40 * torch.rand(1000, 3, generator=seeded(0))
    assert 0 <= noise(points).min() < 0.1 < 0.9 < noise(points).max() <= 1
    assert_near(noise(points + 32), noise(points), atol=1e-3)
    # A smoothstep is at most 1.5 steep along each axis, between values that differ by at most 1.
    assert (noise(points + 1e-2) - noise(points)).abs().max() < 3 * 1.5 * 1e-2 + 1e-3


def test_patterns_alternate():
    def light(texture, *points):
        colours = texture(torch.tensor(points))
        return [torch.equal(colour, torch.tensor(LIGHT)) for colour in colours]

    row = [(0.05 + 0.1 * k, 0.05, 0.05) for k in range(4)]
    found = light(checker(DARK, LIGHT, 0.1), *row)
    assert found in ([True, False] * 2, [False, True] * 2)
    quarters = [(1.0, 0.5, 0.0), (-0.5, 1.0, 0.0), (-1.0, -0.5, 0.0), (0.5, -1.0, 0.0)]
    found = light(polar_checker(DARK, LIGHT, 4, 9.0), *quarters)
    assert found in ([True, False] * 2, [False, True] * 2)
    # Half a turn, divided by the turns of a stripe and its gap, is where the next begins.
    turned = [(1.0, 0.1, z) for z in (0.0, torch.pi / 2, torch.pi)]
    first, second, third = light(spiral(DARK, LIGHT, 2, 1.0), *turned)
    assert first != second != third
    dots = [(0.1, 0.0, 0.0), (0.15, 0.05, 0.0), (0.2, 0.0, 0.01)]
    assert light(pips(DARK, LIGHT, 0.1, 0.02), *dots) == [True, False, True]
