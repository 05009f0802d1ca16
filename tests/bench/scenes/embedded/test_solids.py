"""Shapes: the hit is the first place where the distance changes sign, the normal its gradient."""

import math

import pytest
import torch

from bench.scenes.embedded.solids import (
    Capsule,
    Carved,
    Common,
    Cuboid,
    Cylinder,
    Ellipsoid,
    Shape,
    Shifted,
)
from tests.common import assert_near, seeded

SHAPES: dict[str, Shape] = {
    "ellipsoid": Ellipsoid((0.9, 0.4, 0.6)),
    "box": Cuboid((0.5, 0.8, 0.3)),
    "cylinder": Cylinder(0.5, 0.7),
    "capsule": Capsule(0.3, 0.5),
    "common": Common(Cylinder(0.6, 0.6), Shifted(Ellipsoid((0.7,) * 3), (0.3, 0, 0.2))),
    "carved": Carved(
        Cuboid((0.6, 0.6, 0.4)),
        [
            Shifted(Ellipsoid((0.3, 0.3, 0.3)), (0.6, 0.0, 0.0)),
            Shifted(Ellipsoid((0.4, 0.3, 0.3)), (0.4, 0.3, 0.3)),
            Shifted(Cylinder(0.2, 1.0), (-0.3, 0.0, 0.0)),
        ],
    ),
}
REACH, STEPS = 6.0, 1500


@pytest.fixture(params=SHAPES)
def shape(request) -> Shape:
    """Every kind of shape in turn."""
    return SHAPES[request.param]


def rays(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Origins inside and around the shapes, directions of any length, [count, 3] float64."""
    generator = seeded(7)
    origins = 4 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 2
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions[: count // 2] -= origins[: count // 2]  # half of them towards the middle
    return origins, directions


def hits(shape: Shape, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    return shape.hit(tuple(origins.unbind(1)), tuple(directions.unbind(1)))


def met(shape: Shape, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Where rays hit the shape, and the directions of these rays, [N, 3]."""
    origins, directions = rays(count)
    found = hits(shape, origins, directions)
    hit = found.isfinite()
    return origins[hit] + found[hit, None] * directions[hit], directions[hit]


def test_the_hit_is_the_first_change_of_sign(shape):
    origins, directions = rays(300)
    found = hits(shape, origins, directions)
    assert 20 < found.isfinite().sum() < 290
    t = torch.linspace(0, REACH, STEPS, dtype=torch.float64)
    points = origins[:, None] + t[:, None] * directions[:, None]
    distance = shape.distance(points.reshape(-1, 3)).reshape(300, STEPS)
    inside = distance < 0
    # Rays that graze the surface may cross it twice between two steps: no verdict on those.
    before = t < found[:, None] - 1e-9
    same = (inside == inside[:, :1]) | (distance.abs() < 1e-4) | ~before
    assert same.all()


def test_the_sign_changes_at_the_hit(shape):
    points, directions = met(shape, 300)
    assert shape.distance(points).abs().max() < 1e-9
    step = 1e-5 * directions / directions.norm(dim=1, keepdim=True)
    across = (shape.normal(points) * step).sum(1).abs() > 1e-7  # not along the surface
    before, after = shape.distance(points - step), shape.distance(points + step)
    edges = (before * after > 0) & across
    # Closer to an edge than the step the ray may leave again: a share of about step / size.
    assert edges.sum() <= 1


def test_normals_are_the_gradient_of_the_distance(shape):
    points, _ = met(shape, 300)
    steps = 1e-6 * torch.eye(3, dtype=torch.float64)
    rise = [shape.distance(points + step) - shape.distance(points - step) for step in steps]
    gradient = torch.stack(rise, dim=1) / 2e-6
    smooth = (gradient.norm(dim=1) - 1).abs() < 1e-3  # else an edge lies within the step
    assert smooth.float().mean() > 0.98
    assert_near(shape.normal(points)[smooth], gradient[smooth], atol=1e-3)


def test_the_extent_holds_every_hit(shape):
    points, _ = met(shape, 2000)
    assert (points.abs() <= torch.tensor(shape.extent(), dtype=torch.float64) + 1e-9).all()


def test_a_thin_wire_far_away_keeps_its_thickness_in_float32():
    radius, far = 0.006, 5.0
    offset = torch.linspace(-1.5 * radius, 1.5 * radius, 3001)
    directions = (offset / far, torch.ones_like(offset), torch.zeros_like(offset))
    found = Capsule(radius, 0.5).hit((0.0, -far, 0.0), directions)
    # Tangents from 5 away touch at an angle of asin(r / far).
    edge = far * math.tan(math.asin(radius / far))
    certain = (offset.abs() - edge).abs() > 1e-3 * radius
    assert torch.equal(found.isfinite()[certain], (offset.abs() < edge)[certain])
    middle = found[1500].item()
    assert middle == pytest.approx(far - radius, abs=4 * far * torch.finfo(torch.float32).eps)


@pytest.mark.parametrize("axis", range(3))
def test_rays_along_an_axis_meet_box_and_cylinder(axis):
    directions = [torch.zeros(1), torch.zeros(1), torch.zeros(1)]
    directions[axis] = torch.ones(1)
    origin = [0.1, 0.1, 0.1]
    origin[axis] = -2.0
    wall = math.sqrt(0.25 - 0.01)
    aside = list(origin)
    aside[(axis + 1) % 3] = 1.0
    for shape, reach in ((Cuboid((0.5, 0.6, 0.7)), (0.5, 0.6)), (Cylinder(0.5, 0.7), (wall, wall))):
        met = shape.hit(tuple(origin), tuple(directions)).item()
        assert met == pytest.approx(2 - (*reach, 0.7)[axis])
        assert shape.hit(tuple(aside), tuple(directions)).isinf().all()
