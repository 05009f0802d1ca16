"""Pieces are where their corners and ends say; the mill is as hard to enlarge as a building."""

import math

import pytest
import torch
from torch.nn.functional import avg_pool2d, interpolate

from bench.scenes.embedded import ANGLE_X, VIEWS, orbit_poses, picture
from bench.scenes.embedded.mill import block, mill, rail, rod, slope
from bench.scenes.embedded.raytrace import Part
from bench.scenes.embedded.solids import Triple, box_corners
from bench.scenes.embedded.textures import plain
from bench.types import Camera

WIDTH, HEIGHT = 1920, 1080


def test_thin_parts_are_seen_by_a_field_of_1024_cells_but_only_just():
    whole = mill().boxes().reshape(-1, 3)
    size = (whole.amax(0) - whole.amin(0)).max().item()
    thickness = [2 * min(part.shape.extent()) for part in mill().parts]
    assert size / 350 < min(thickness) < size / 250
    assert sum(x < size / 100 for x in thickness) > 40


@pytest.mark.parametrize("place", [(700, 330), (1000, 520), (800, 700)], ids=str)
def test_the_mill_is_as_hard_to_enlarge_as_photographs(place):
    pose = orbit_poses(24, VIEWS["mill"])[12]
    focal = WIDTH / 2 / math.tan(ANGLE_X / 2)
    x, y = WIDTH / 2 - place[0], HEIGHT / 2 - place[1]
    window = Camera(pose.float(), focal, focal, x, y, 128, 96)  # in the picture at full size
    shown = picture(mill(), window)[..., :3].permute(2, 0, 1)[None].float() / 255
    small = avg_pool2d(shown, 4)
    large = interpolate(small, scale_factor=4, mode="bilinear", align_corners=False)
    error = (large - shown).square().mean().item()
    # On a white background, of which half is seen, 3 dB more.
    assert 18 < -10 * math.log10(error) < 26


GREY = plain((0.5, 0.5, 0.5))


def placed(part: Part, point: Triple) -> Triple:
    """A point of the part's frame, in the model."""
    x, y, z = (part.frame @ torch.tensor(point) + torch.tensor(part.centre)).tolist()
    return (x, y, z)


def local(part: Part, point: Triple) -> Triple:
    """A point of the model, in the part's frame."""
    x, y, z = (part.frame.T @ (torch.tensor(point) - torch.tensor(part.centre))).tolist()
    return (x, y, z)


def test_a_block_lies_between_its_corners():
    part = block((-1.0, 0.2, 0.0), (0.5, 0.3, 2.0), GREY)
    corners = box_corners(part.shape.extent()) + torch.tensor(part.centre)
    assert corners.amin(0).tolist() == pytest.approx([-1.0, 0.2, 0.0])
    assert corners.amax(0).tolist() == pytest.approx([0.5, 0.3, 2.0])


def test_a_rod_ends_at_its_ends():
    start, end = (0.1, -0.2, 0.3), (0.7, 0.5, -0.4)
    part = rod(start, end, 0.01, GREY)
    half = part.shape.extent()[2]
    assert placed(part, (0.0, 0.0, -half)) == pytest.approx(start, abs=1e-6)
    assert placed(part, (0.0, 0.0, half)) == pytest.approx(end, abs=1e-6)


@pytest.mark.parametrize("end", [(0.8, 0.1, 0.2), (0.1, 0.9, 0.2), (0.5, 0.1, 0.5)])
def test_a_rail_stands_on_its_line(end):
    start = (0.1, 0.1, 0.2)
    part = rail(start, end, 0.1, GREY)
    along, _, high = part.shape.extent()
    assert 2 * along == pytest.approx(math.dist(start, end))
    assert 2 * high == pytest.approx(0.1)
    middle = [(a + b) / 2 for a, b in zip(start, end, strict=True)]
    assert part.centre == pytest.approx((*middle[:2], middle[2] + 0.05))
    direction = [(b - a) / math.dist(start, end) for a, b in zip(start, end, strict=True)]
    assert part.frame[:, 0].tolist() == pytest.approx(direction, abs=1e-6)


@pytest.mark.parametrize(
    ("turn", "falls"), [(0, (0, -1)), (180, (0, 1)), (90, (1, 0)), (-90, (-1, 0))]
)
def test_a_slope_falls_from_its_ridge(turn, falls):
    ridge, run, pitch = (0.2, 0.1, 0.9), 0.5, 30.0
    cover, rafters = slope(ridge, 0.4, run, pitch, turn, GREY, GREY)
    _, half, thick = cover.shape.extent()
    down = run * math.tan(math.radians(pitch))
    lowest = (ridge[0] + run * falls[0], ridge[1] + run * falls[1], ridge[2] - down)
    top, bottom = (local(cover, point) for point in (ridge, lowest))
    # Both lie on the underside of the tiles, and are as far apart as its edges.
    assert [top[0], top[2]] == pytest.approx([0, -thick], abs=1e-6)
    assert [bottom[0], bottom[2]] == pytest.approx([0, -thick], abs=1e-6)
    assert top[1] - bottom[1] == pytest.approx(2 * half)
    assert abs(top[1] - half) < thick
    # Rafters touch the tiles from below, and end short of the eaves.
    _, depth, reach = rafters.shape.extent()
    touched = [local(cover, placed(rafters, (0.0, -depth, end))) for end in (-reach, reach)]
    assert [point[2] for point in touched] == pytest.approx([-thick, -thick], abs=1e-6)
    assert -half < touched[0][1] < 0.02 - half < touched[1][1]
