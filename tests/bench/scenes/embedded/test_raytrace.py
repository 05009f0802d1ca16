"""Exact pictures: closed forms of spheres and media, culling that changes nothing, shadows."""

import math

import pytest
import torch

from bench.cameras import cast
from bench.scenes.embedded import raytrace
from bench.scenes.embedded.models import cloud, totem, wires
from bench.scenes.embedded.raytrace import LIGHT, Ball, Media, Part, Solids, render, sample_offsets
from bench.scenes.embedded.solids import Carved, Ellipsoid
from bench.scenes.embedded.textures import plain
from bench.types import EMPTY_ALPHA, Camera
from tests.bench.scenes.conftest import camera_at
from tests.common import seeded

RED = plain((1.0, 0.0, 0.0))


def sphere(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Part:
    return Part(Ellipsoid((radius, radius, radius)), RED, centre)


def test_16_samples_stand_for_the_16_quarter_pixel_cells():
    offsets = sample_offsets(16)
    cells = (offsets * 4).floor().tolist()
    assert sorted(cells) == [[a, b] for a in range(4) for b in range(4)]
    assert len(set(offsets[:, 0].tolist())) == len(set(offsets[:, 1].tolist())) == 16
    assert offsets.mean(0).tolist() == [0.5, 0.5]
    assert sample_offsets(1).tolist() == [[0.5, 0.5]]


def test_the_silhouette_of_a_sphere_has_its_closed_form_area():
    camera = camera_at((0.0, -4.0, 0.0))
    alpha = render(Solids([sphere(0.8)]), camera, samples=16).alpha
    radius = camera.fx * math.tan(math.asin(0.8 / 4))
    # Only quarter-pixel cells that the outline crosses can be counted wrongly, half either way.
    diagonal = math.sqrt(2) / 4
    assert abs(alpha.sum().item() - math.pi * radius**2) <= 2 * math.pi * radius * diagonal


@pytest.mark.parametrize(
    "model",
    [
        Solids([sphere(0.1, (9.0, 9.0, 0.0))]),  # beside the picture, and behind the camera
        Media([Ball((0.0, -6.0, 0.0), 0.5, 9.0, (1.0, 1.0, 1.0))]),
    ],
)
def test_nothing_seen_is_black_at_infinity(model):
    frame = render(model, camera_at((0.0, -4.0, 0.0), 8), 4)
    assert (frame.rgb == 0).all()
    assert frame.depth.isinf().all()
    assert (frame.alpha == 0).all()


def test_depth_is_finite_exactly_where_there_is_opacity():
    frame = render(totem(), camera_at((1.0, -3.5, 1.5), size=64), 16)
    assert torch.equal(frame.depth.isfinite(), frame.alpha >= EMPTY_ALPHA)
    assert ((frame.rgb >= 0) & (frame.rgb <= 1 + 1e-6)).all()


def hits(part: Part, origins: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    local = (origins - torch.tensor(part.centre)) @ part.frame, directions @ part.frame
    return part.shape.hit(*(x.unbind(-1) for x in local))


@pytest.mark.parametrize("model", [totem, wires])
@pytest.mark.parametrize("eye", [(1.0, -3.5, 1.5), (0.3, 0.2, 0.3), (0.0, 0.1, 4.0)])
def test_the_nearest_of_all_parts_is_seen(monkeypatch, model, eye):
    solids, camera = model(), camera_at(eye, size=40)
    monkeypatch.setattr(raytrace, "BAND_RAYS", 40 * 6)  # bands of six rows, the last of four
    depth = render(solids, camera, samples=1).depth.flatten()
    rays = cast(camera)
    met = [hits(part, rays.origins, rays.directions) for part in solids.parts]
    nearest = torch.stack(met).amin(dim=0)
    # Only rounding may differ, and it can turn a ray that grazes an edge.
    differing = (nearest - depth).abs() > 1e-4  # not where both are infinite
    assert differing.sum() <= 2
    assert (nearest.isfinite() != depth.isfinite()).sum() <= 2
    assert nearest.isfinite().any()


@pytest.mark.parametrize("model", [totem, wires])
def test_shadows_are_those_of_all_parts_but_of_a_convex_one_on_itself(model):
    solids, generator = model(), seeded(3)
    points = 2.4 * torch.rand(6000, 3, generator=generator) - 1.2
    owners = torch.randint(len(solids.parts), (6000,), generator=generator).to(torch.int16)
    assert math.hypot(*LIGHT) == pytest.approx(1, abs=1e-6)
    dark = torch.zeros(6000, dtype=torch.bool)
    for number, part in enumerate(solids.parts):
        found = hits(part, points, torch.tensor(LIGHT)).isfinite()
        dark |= found & ((owners != number) | isinstance(part.shape, Carved))
    # Rounding can turn a ray that grazes an edge.
    assert (solids.shadowed(owners, points) != dark).sum() <= 1
    assert 100 < dark.sum() < 5900


def test_highlights_move_with_the_viewer():
    glossy = Solids([Part(Ellipsoid((0.7, 0.7, 0.7)), RED, gloss=0.9)])
    places = []
    for eye in ((0.0, -4.0, 0.0), (1.5, -3.7, 0.0)):
        camera = camera_at(eye)
        shiny = render(glossy, camera, 4)
        matt = render(Solids([sphere(0.7)]), camera, 4)
        glow = (shiny.rgb - matt.rgb)[..., 1]
        brightest = glow.argmax()
        depth = matt.depth.flatten()[brightest]
        rays = cast(camera)
        places.append(rays.origins[brightest] + depth * rays.directions[brightest])
    assert (places[0] - places[1]).norm() > 0.05


@pytest.mark.parametrize("density", [0.01, 1.0, 30.0])
def test_one_ball_through_its_middle(density):
    model = Media([Ball((0.0, 0.0, 0.0), 0.5, density, (0.8, 0.4, 0.2))])
    frame = render(model, camera_at((0.0, -4.0, 0.0), 1), samples=1)
    alpha = 1 - math.exp(-density)
    # Mean of an exponential of rate k cut off at 1: 1 / k - 1 / (e^k - 1), from t = 3.5 on.
    depth = 3.5 + 1 / density - 1 / math.expm1(density)
    assert frame.alpha.item() == pytest.approx(alpha, rel=1e-5)
    assert frame.depth.item() == pytest.approx(depth, rel=2e-5)
    assert frame.rgb.flatten().tolist() == pytest.approx(
        [0.8 * alpha, 0.4 * alpha, 0.2 * alpha], rel=1e-5
    )


def quadrature(model: Media, camera: Camera, steps: int) -> tuple[torch.Tensor, ...]:
    """rgb, alpha, and depth times alpha of the pixel centres, by the midpoint rule on [0, 6]."""
    rays = cast(camera)
    width = 6 / steps
    t = (torch.arange(steps, dtype=torch.float64) + 0.5) * width
    points = rays.origins.double()[:, None] + t[:, None] * rays.directions.double()[:, None]
    sigma = torch.zeros(points.shape[:2], dtype=torch.float64)
    glow = torch.zeros_like(points)
    for ball in model.balls:
        inside = (points - torch.tensor(ball.centre)).norm(dim=-1) < ball.radius
        sigma += ball.density * inside
        glow += ball.density * inside[..., None] * torch.tensor(ball.colour)
    thickness = sigma * width * rays.directions.double().norm(dim=1, keepdim=True)
    passed = torch.exp(-thickness.cumsum(1))  # after each step
    weight = passed * torch.expm1(thickness)
    colour = glow / sigma.clamp(min=1e-12)[..., None]
    return (weight[..., None] * colour).sum(1), 1 - passed[:, -1], (weight * t).sum(1)


@pytest.mark.parametrize("eye", [(0.5, -3.0, 1.0), (0.1, 0.0, -0.4)], ids=["outside", "inside"])
def test_overlapping_balls_against_quadrature(eye):
    camera = camera_at(eye, 12)
    frame = render(cloud(), camera, samples=1)
    rgb, alpha, depth = quadrature(cloud(), camera, steps=6000)
    # A step that a surface cuts is wrong by its optical thickness at most, k h |d|: surfaces come
    # in pairs, densities sum to 70.
    error = 2 * 70 * (6 / 6000) * 1.2 / 2
    assert (frame.alpha.flatten() - alpha).abs().max() <= error
    assert (frame.rgb.reshape(-1, 3) - rgb).abs().max() <= error
    seen = alpha > 0.05
    got = (frame.depth * frame.alpha).flatten()[seen]
    assert (got - depth[seen]).abs().max() <= 4 * error
    # And on average far closer, for errors at the surfaces have both signs.
    assert (frame.alpha.flatten() - alpha).abs().mean() <= error / 20
