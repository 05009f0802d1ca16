"""Rendering rays all at once, to train."""

import math

import pytest
import torch
from torch import Tensor

from bench.cameras import cast, place_camera
from bench.types import Rays
from methods.instant_ngp.field import HashField
from methods.kernels.composite import composite, visibility
from methods.kernels.march import march
from methods.kernels.types import Occupancy, Pixels, Samples
from methods.rendering.batch import (
    KEPT_THIN,
    NEAR,
    Round,
    opacity_entropy,
    render_batch,
    thinned,
    visible_samples,
)
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from tests.common import seeded
from tests.methods.conftest import look_at_the_middle

Thick = tuple[HashField, Occupancy, Rays]


@pytest.fixture
def thick(cloud, device) -> Thick:
    """The cloud a hundred times as dense, so that it hides its own samples, and rays through it."""
    field, occupancy = cloud
    thin = field.density

    def density(positions, known=None):
        sigma, geometry = thin(positions, known)
        return 100 * sigma, geometry

    field.density = density
    return field, occupancy, rays_on(device)


def rays_on(device: str) -> Rays:
    """Rays through the cloud."""
    return cast(place_camera(look_at_the_middle(0.1, 0.4), device))


def learned(pixels: Pixels, field: HashField) -> list[Tensor]:
    """The gradients of all parameters, for some loss of `pixels`."""
    return list(torch.autograd.grad(pixels.values.square().sum(), list(field.parameters())))


def shaded(field: HashField, rays: Rays, samples: Samples) -> tuple[Tensor, Tensor]:
    """Density and features of all samples."""
    sigma, geometry = field.density(samples.positions)
    return sigma, field.features(geometry, field.encode_directions(rays.directions)[samples.ray])


def assert_alike(found: list[Tensor], wanted: list[Tensor]) -> None:
    """Sums over up to 10^5 samples, in another grouping."""
    assert len(found) == 6
    for some, want in zip(found, wanted, strict=True):
        torch.testing.assert_close(some, want, rtol=1e-3, atol=1e-4 * want.abs().max().item())


def test_leaving_out_hidden_samples_changes_no_gradient(thick, device):
    field, occupancy, rays = thick
    jitter = torch.rand(len(rays.origins), generator=seeded(0)).to(device)
    white = torch.ones(3, device=device)
    samples = march(rays, occupancy, STEP, jitter=jitter)
    whole = learned(composite(*shaded(field, rays, samples), samples).over(white), field)
    shown = {"jitter": jitter, "background": white}
    pixels, used = render_batch(field, rays, occupancy, Sampling(), **shown)
    assert used < 0.9 * len(samples)
    assert_alike(learned(pixels, field), whole)


def test_thin_samples_are_kept_in_turn_for_the_others(cloud, device):
    field, occupancy = cloud
    rays = rays_on(device)
    jitter = torch.full((len(rays.origins),), 0.5, device=device)
    samples = march(rays, occupancy, STEP, jitter=jitter)
    sigma = field.density(samples.positions)[0].detach()
    counts = visibility(sigma, samples).counts
    every, depth = samples.front(counts), (sigma * samples.delta).median().item()

    # The turns of one phase take all thin samples once, each with the length of all.
    rounds = [Round(slice(None), samples, sigma, counts)]
    turns = [thinned(rounds, depth, torch.full_like(counts, 5 + n)) for n in range(KEPT_THIN)]
    length, number = torch.zeros(2, len(rays.origins), device=device)
    for kept in turns:
        assert len(kept) < 0.8 * len(every)
        assert torch.equal(kept.offsets.diff(), torch.bincount(kept.ray, minlength=len(length)))
        length.index_add_(0, kept.ray, kept.delta / KEPT_THIN)
        number.index_add_(0, kept.ray, torch.where(kept.delta > every.delta.max(), 1.0, 0.25))
    assert torch.equal(number, every.offsets.diff().float())
    expected = torch.zeros_like(length).index_add_(0, every.ray, every.delta)
    # Sums of at most 1,024 steps, in another order.
    torch.testing.assert_close(length, expected, rtol=1024 * 2**-24, atol=0)


def test_rounds_change_no_sample(thick, monkeypatch):
    """But for a transmittance that reaches `stop` just where a round ends: it is rounded there."""
    field, occupancy, rays = thick
    jitter = torch.full((len(rays.origins),), 0.7, device=rays.origins.device)
    hows, found = (Sampling(), Sampling(thin=1.0)), []
    for rounds in ((), (2,), (1, 3)):
        monkeypatch.setattr("methods.rendering.batch.FIRST_ROUNDS", rounds)
        found.append([visible_samples(field, rays, occupancy, h, jitter=jitter) for h in hows])
    for chosen in found[1:]:
        for samples, want in zip(chosen, found[0], strict=True):
            for name in ("t", "delta", "offsets", "ray", "positions"):
                assert torch.equal(getattr(samples, name), getattr(want, name)), name
            with torch.no_grad():
                assert torch.equal(samples.encoded, field.encode(samples.positions))
    assert 0 < len(found[0][1]) < len(found[0][0])


def test_a_teacher_tells_which_samples_are_hidden(cloud, device):
    field, occupancy = cloud
    rays = rays_on(device)

    class Teacher:
        """As dense everywhere as is given, without colours."""

        def __init__(self, sigma):
            self.density = lambda places: (torch.full_like(places[:, 0], sigma), places)

    own, most = render_batch(field, rays, occupancy, Sampling(stop=0))
    clear, all_ = render_batch(field, rays, occupancy, Sampling(stop=0), teacher=Teacher(0.0))
    assert all_ == most
    assert torch.equal(own.values, clear.values)
    # Opaque at once: only the first sample of every ray is seen.
    wall, few = render_batch(field, rays, occupancy, Sampling(), teacher=Teacher(1e6))
    offsets = march(rays, occupancy, STEP).offsets
    assert few == int((offsets.diff() > 0).sum())
    assert (wall.alpha <= own.alpha + 1e-6).all()


def test_the_entropy_of_opacities_is_smallest_where_rays_are_opaque_or_empty():
    assert opacity_entropy(torch.tensor([0.5])).item() == pytest.approx(0.5 * math.log(2))
    assert opacity_entropy(torch.tensor([0.0, 1.0])).item() == pytest.approx(0, abs=1e-4)
    opacity = torch.tensor([0.2, 0.6], requires_grad=True)  # on both sides of the largest, 1 / e
    opacity_entropy(opacity).backward()
    assert opacity.grad[0] > 0 > opacity.grad[1]


def test_where_space_has_no_end_gradients_grow_with_the_squared_distance(cloud, device):
    field, occupancy = cloud
    occupancy, rays = Occupancy(occupancy.cells, contracted=True), rays_on(device)
    rays = Rays(0.5 + 0.1 * (rays.origins - 0.5), rays.directions)  # the nearest samples are near
    samples = march(rays, occupancy, STEP)
    away = samples.t * rays.directions.norm(dim=1)[samples.ray]
    share = (away / NEAR).square().clamp(max=1)
    assert share.min() < 0.3
    assert share.max() == 1
    sigma, values = shaded(field, rays, samples)
    sigma.register_hook(lambda gradient: gradient * share)
    values.register_hook(lambda gradient: gradient * share[:, None])
    want = learned(composite(sigma, values, samples), field)
    pixels, _ = render_batch(field, rays, occupancy, Sampling())
    assert_alike(learned(pixels, field), want)
