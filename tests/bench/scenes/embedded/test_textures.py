"""Noise, and patterns where they can be told beforehand: joints, tones, what goes on in parts."""

import math

import pytest
import torch

from bench.scenes.embedded.mill import block
from bench.scenes.embedded.textures import (
    Texture,
    bricks,
    cells,
    checker,
    lattice,
    noise,
    panes,
    pips,
    planks,
    polar_checker,
    rough,
    setts,
    spiral,
    tiles,
    tone,
)

DARK, LIGHT, THIRD = (0.1, 0.1, 0.2), (0.7, 0.6, 0.5), (0.3, 0.5, 0.2)
TEXTURES: dict[str, Texture] = {
    "bricks": bricks(DARK, LIGHT, THIRD, (0.034, 0.012, 0.003)),
    "planks": planks(DARK, LIGHT, (0.03, 0.004), False),
    "floor": planks(DARK, LIGHT, (0.03, 0.004), True),
    "tiles": tiles(DARK, LIGHT, THIRD, (0.03, 0.026)),
    "setts": setts(DARK, LIGHT, THIRD, 0.03),
    "rough": rough(DARK, LIGHT),
    "panes": panes(DARK, LIGHT, (0.04, 0.04, 0.045)),
}


def scattered(count: int) -> torch.Tensor:
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(5)) - 1


@pytest.mark.parametrize("name", TEXTURES)
def test_a_texture_is_coloured_and_varies_from_place_to_place(name):
    points = scattered(4000)
    colours = TEXTURES[name](points)
    assert colours.shape == (4000, 3)
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert (colours.std(0) > 0.03).all()
    # Within a hair's breadth there is no pattern, but for the borders of pieces.
    near = TEXTURES[name](points + 1e-5)
    assert ((near - colours).abs().amax(1) < 0.02).float().mean() > 0.98


def test_joints_have_their_share_of_a_wall():
    x, y, z = scattered(200_000).unbind(1)
    _, _, inside = cells(x + y, z, 0.034, 0.012)
    share = (inside < 0.0015).float().mean().item()
    assert share == pytest.approx(1 - (1 - 0.003 / 0.034) * (1 - 0.003 / 0.012), abs=0.005)


def test_pieces_are_laid_half_a_piece_on_in_every_other_row():
    u = torch.linspace(0.01, 3.99, 400)
    row, column, _ = cells(u, torch.full_like(u, 0.5), 1.0, 1.0)
    above, shifted, _ = cells(u - 0.5, torch.full_like(u, 1.5), 1.0, 1.0)
    assert torch.equal(column, shifted)
    assert {*row.tolist()} == {0.0}
    assert {*above.tolist()} == {1.0}


def test_tones_are_evenly_spread_and_come_again_only_after_1024_pieces():
    row, column = torch.cartesian_prod(*(torch.arange(-64.0, 64),) * 2).unbind(1)
    tones = tone(row, column)
    assert tones.mean().item() == pytest.approx(0.5, abs=0.02)
    assert tones.std().item() == pytest.approx(1 / math.sqrt(12), abs=0.02)
    assert torch.equal(tones, tone(row, column + 1024))
    for away in (1, 32, 64):
        assert (tones == tone(row, column + away)).float().mean() < 0.1
        assert (tones == tone(row + away, column)).float().mean() < 0.1


def test_a_pattern_goes_on_from_part_to_part():
    wall = block((0.0, 0.0, 0.0), (1.0, 0.2, 0.5), TEXTURES["bricks"])
    more = block((0.6, 0.0, 0.3), (2.0, 0.2, 0.9), TEXTURES["bricks"])
    shared = torch.rand(500, 3) * torch.tensor((0.4, 0.0, 0.2)) + torch.tensor((0.6, 0.0, 0.3))
    seen = [
        part.texture((shared - torch.tensor(part.centre)) @ part.frame) for part in (wall, more)
    ]
    # Only rounding may differ, and it can turn a point at the border of a piece.
    assert ((seen[0] - seen[1]).abs().amax(1) > 1e-3).sum() <= 2


def test_noise_is_that_of_its_lattice_continuous_and_has_a_period():
    corners = torch.cartesian_prod(*3 * [torch.arange(4.0)])
    x, y, z = corners.long().unbind(1)
    # The first coordinate of `grid_sample` runs along the last axis.
    torch.testing.assert_close(noise(corners), lattice()[z, y, x], rtol=0, atol=1e-4)
    points = 40 * torch.rand(1000, 3, generator=torch.Generator().manual_seed(0))
    assert 0 <= noise(points).min() < 0.1 < 0.9 < noise(points).max() <= 1
    torch.testing.assert_close(noise(points + 32), noise(points), rtol=0, atol=1e-3)
    # A smoothstep is at most 1.5 steep along each axis, between values that differ by at most 1.
    assert (noise(points + 1e-2) - noise(points)).abs().max() < 3 * 1.5 * 1e-2 + 1e-3


def test_patterns_alternate():
    def light(texture, *points: tuple[float, float, float]) -> list[bool]:
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
