"""Rendering rays all at once, to train."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from bench.cameras import cast
from bench.types import Rays
from methods.instant_ngp.field import HashField
from methods.kernels.composite import composite
from methods.kernels.march import march
from methods.kernels.types import Occupancy, Samples
from methods.rendering.batch import (
    KEPT_THIN,
    FirstPass,
    Round,
    first_pass,
    render_batch,
    second_pass,
)
from methods.rendering.occupancy import STEP
from methods.rendering.sampling import Sampling
from tests.methods.conftest import look_at_the_middle

Thick = tuple[HashField, Occupancy, Rays]


@pytest.fixture
def thick(cloud: tuple[HashField, Occupancy], device: str) -> Thick:
    """The cloud a hundred times as dense, so that it hides its own samples, and rays through it."""
    field, occupancy = cloud
    thin = field.density

    def density(positions: Tensor, known: Tensor | None = None) -> tuple[Tensor, Tensor]:
        sigma, geometry = thin(positions, known)
        return 100 * sigma, geometry

    field.density = density  # type: ignore[method-assign]
    camera = look_at_the_middle(0.1, 0.4)
    return field, occupancy, cast(replace(camera, c2w=camera.c2w.to(device)))


def test_leaving_out_hidden_samples_changes_no_gradient(thick: Thick, device: str) -> None:
    field, occupancy, rays = thick
    jitter = torch.rand(len(rays.origins), generator=torch.Generator().manual_seed(0)).to(device)
    white = torch.ones(3, device=device)

    pixels, used = render_batch(field, rays, occupancy, Sampling(), jitter=jitter, background=white)
    pixels.values.square().sum().backward()
    grads = [p.grad.clone() for p in field.parameters() if p.grad is not None]
    field.zero_grad()

    samples = march(rays, occupancy, STEP, jitter=jitter)
    sigma, geometry = field.density(samples.positions)
    values = field.features(geometry, field.encode_directions(rays.directions)[samples.ray])
    whole = composite(sigma, values, samples).over(white)
    whole.values.square().sum().backward()

    assert used < 0.9 * len(samples)
    assert len(grads) == 6
    for got, want in zip(grads, (p.grad for p in field.parameters()), strict=True):
        assert want is not None
        # Sums over up to 10^5 samples, in another grouping.
        torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-4 * want.abs().max().item())


def test_thin_samples_are_kept_in_turn_and_stand_for_the_others(
    cloud: tuple[HashField, Occupancy], device: str
) -> None:
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(device)))
    jitter = torch.full((len(rays.origins),), 0.5, device=device)
    first = first_pass(field, rays, occupancy, Sampling(), jitter=jitter)
    every = first.visible()
    depth = (field.density(every.positions)[0] * every.delta).median().item()
    thick = first.thinned(0.0, jitter)
    assert torch.equal(thick.offsets, every.offsets)
    assert torch.equal(thick.delta, every.delta)

    # The turns of one phase take all thin samples once, each with the length of all.
    turns = [first.thinned(depth, jitter + turn / 2**12) for turn in range(KEPT_THIN)]
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


def round_of(rays: list[int] | None, held: list[int], seen: list[int], sigma: list[int]) -> Round:
    """The next samples of `rays`: each has as many as `held` says, of which `seen` are visible."""
    ray = torch.arange(len(held)).repeat_interleave(torch.tensor(held)).int()
    place = torch.arange(len(ray)).float()
    offsets, resume = torch.tensor([0, *held]).cumsum(0), torch.zeros(len(held)).int()
    samples = Samples(
        place, torch.ones(len(ray)), offsets, ray, place[:, None].expand(-1, 3), resume
    )
    chosen = None if rays is None else torch.tensor(rays)
    return Round(chosen, samples, torch.tensor(sigma).float(), torch.tensor(seen))


def test_of_the_thin_samples_of_a_ray_every_fourth_is_kept_through_its_rounds() -> None:
    """Ray 0 has samples 0 to 2 and 6 to 8, of which 8 is hidden; ray 1 has 3 to 5; ray 2 none."""
    first = round_of(None, [3, 3, 0], [3, 2, 0], [0, 9, 0, 0, 0, 9])
    second = round_of([0], [3], [2], [0, 0, 9])
    turns = torch.tensor([0.0, 3.0, 0.0]) / 2**12
    kept = FirstPass([first, second]).thinned(1.0, turns)
    # Of ray 0 numbers 0 (thin), 1 (thick) and 4 (thin); of ray 1, which begins at 3, number 4.
    assert kept.ray.tolist() == [0, 0, 0, 1]
    assert kept.t.tolist() == [0, 1, 1, 4]
    assert kept.delta.tolist() == [4, 1, 4, 4]
    assert kept.offsets.tolist() == [0, 3, 4, 4]


def test_the_rounds_of_the_first_pass_change_no_sample(
    thick: Thick, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for a transmittance that reaches `stop` just where a round ends: it is rounded there."""
    field, occupancy, rays = thick
    jitter = torch.full((len(rays.origins),), 0.7, device=rays.origins.device)
    found = []
    for rounds in ((), (2,), (1, 3)):
        monkeypatch.setattr("methods.rendering.batch.FIRST_ROUNDS", rounds)
        first = first_pass(field, rays, occupancy, Sampling(), jitter=jitter)
        found.append((first.counts, first.visible(), first.thinned(1.0, jitter)))
    for counts, *chosen in found[1:]:
        assert torch.equal(counts, found[0][0])
        for samples, want in zip(chosen, found[0][1:], strict=True):
            for name in ("t", "delta", "offsets", "ray", "positions"):
                assert torch.equal(getattr(samples, name), getattr(want, name)), name
            with torch.no_grad():
                assert torch.equal(samples.encoded, field.encode(samples.positions))
    assert 0 < len(found[0][2]) < len(found[0][1])


def test_hidden_samples_may_be_evaluated_too(thick: Thick) -> None:
    field, occupancy, rays = thick
    grads, used = [], []
    for hidden in (False, True):
        pixels, samples = render_batch(field, rays, occupancy, Sampling(), hidden=hidden)
        pixels.values.square().sum().backward()
        grads.append([p.grad.clone() for p in field.parameters() if p.grad is not None])
        used.append(samples)
        field.zero_grad()
    assert used[0] < 0.9 * used[1]
    for got, want in zip(*grads, strict=True):
        # Sums over up to 10^5 samples, in another grouping.
        torch.testing.assert_close(got, want, rtol=1e-3, atol=1e-4 * want.abs().max().item())


def test_rays_are_opaque_where_any_of_their_samples_is(
    cloud: tuple[HashField, Occupancy], device: str
) -> None:
    field, occupancy = cloud
    holey = field.density

    def density(positions: Tensor, known: Tensor | None = None) -> tuple[Tensor, Tensor]:
        sigma, geometry = holey(positions, known)
        return torch.where(positions[:, 0] < 0.5, sigma, 0), geometry

    field.density = density  # type: ignore[method-assign]
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(device)))
    first = first_pass(field, rays, occupancy, Sampling())
    samples = march(rays, occupancy, STEP)
    alpha = second_pass(field, rays, samples, Sampling()).alpha
    assert 0 < (alpha > 0).sum() < (samples.offsets.diff() > 0).sum()
    assert torch.equal(first.opaque(), alpha > 0)


def test_a_guide_tells_which_samples_are_hidden(
    cloud: tuple[HashField, Occupancy], device: str
) -> None:
    field, occupancy = cloud
    camera = look_at_the_middle(0.1, 0.4)
    rays = cast(replace(camera, c2w=camera.c2w.to(device)))

    class Guide:
        """As dense everywhere as is given, without colours."""

        def __init__(self, sigma: float) -> None:
            self.sigma = sigma

        def density(self, positions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return torch.full_like(positions[:, 0], self.sigma), positions

    own, most = render_batch(field, rays, occupancy, Sampling(stop=0))
    clear, all_ = render_batch(field, rays, occupancy, Sampling(stop=0), guide=Guide(0.0))  # type: ignore[arg-type]
    assert all_ == most
    assert torch.equal(own.values, clear.values)
    # Opaque at once: only the first sample of every ray is seen.
    wall, few = render_batch(field, rays, occupancy, Sampling(), guide=Guide(1e6))  # type: ignore[arg-type]
    offsets = march(rays, occupancy, STEP).offsets
    assert few == int((offsets.diff() > 0).sum())
    assert (wall.alpha <= own.alpha + 1e-6).all()
