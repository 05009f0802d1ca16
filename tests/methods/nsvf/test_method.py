"""NSVF as a method: its voxels, its network, and where its embeddings begin."""

import math
from itertools import chain, pairwise

import pytest
import torch
from torch import nn
from torch.nn import functional

from methods.instant_ngp.stage1 import train_field
from methods.kernels.encode import encode
from methods.kernels.types import Occupancy
from methods.nsvf.field import NsvfField
from tests.common import assert_near, refusal, seeded
from tests.methods.small_students import SMALL, budget, fitted
from tests.methods.trainings import EXACT_GRID, TEACHER

BUDGET = budget("nsvf", 4)
U = 2.0**-24
SINES = (torch.sin, torch.cos)


def two_thirds() -> NsvfField:
    """Random voxels of a grid of 16^3, with random embeddings, in float64."""
    generator = seeded(2)
    occupancy = Occupancy(torch.rand(16, 16, 16, generator=generator) < 2 / 3)
    return NsvfField(occupancy, "fp32", "reference", generator).double()


def test_embeddings_are_those_of_grid_sample():
    field = two_thirds()
    dense = torch.full((17, 17, 17, 32), torch.nan, dtype=torch.float64)
    x, y, z = field.vertices.long().unbind(dim=1)
    dense[x, y, z] = field.embeddings.detach()
    positions = torch.rand(500, 3, dtype=torch.float64, generator=seeded(3))
    found, inside = field.embedding(positions)
    # grid_sample has its volume as [C, z, y, x] and its coordinates in [-1, 1].
    volume = dense.permute(3, 2, 1, 0)[None]
    grid = (2 * positions - 1)[None, None, None]
    wanted = functional.grid_sample(volume, grid, align_corners=True)[0, :, 0, 0].T
    assert 100 < inside.sum() < 450
    # Positions become coordinates in another order of operations; NaN where a corner is missing.
    assert_near(found[inside], wanted[inside], atol=1e-12)


def test_density_is_zero_outside_voxels():
    field = two_thirds()
    nn.init.constant_(field.opacity[-1].bias, 10.0)
    axis = (torch.arange(16, dtype=torch.float64) + 0.5) / 16
    sigma, _ = field.density(torch.cartesian_prod(axis, axis, axis))
    assert torch.equal(sigma.view(16, 16, 16) > 0, field.index >= 0)


def test_the_network_is_that_of_the_publication():
    """And its encodings those of the release, in which only that of angles goes without pi."""
    field = two_thirds().float()
    network = sum(p.numel() for name, p in field.named_parameters() if name != "embeddings")
    assert network == 545_284
    assert field.sizes() == {"embeddings": 128 * len(field.vertices), "network": 4 * 545_284}

    def hidden(*widths):
        pairs = [(nn.Linear(*pair), nn.LayerNorm(pair[1]), nn.ReLU()) for pair in pairwise(widths)]
        return chain(*pairs)

    trunk = nn.Sequential(*hidden(416, 256, 256, 256))
    opacity = nn.Sequential(*hidden(256, 128), nn.Linear(128, 1), nn.ReLU())
    colour = nn.Sequential(*hidden(280, *[256] * 4), nn.Linear(256, 3))
    for mine, other in ((field.trunk, trunk), (field.opacity, opacity), (field.colour, colour)):
        other.load_state_dict(dict(zip(other.state_dict(), mine.parameters(), strict=True)))
    places = torch.rand(300, 3, generator=seeded(4))
    d = functional.normalize(torch.randn(300, 3, generator=seeded(5)), dim=1)
    e, inside = field.embedding(places)
    encoded = torch.cat((e, *(f(math.pi * 2**k * e) for k in range(6) for f in SINES)), 1)
    seen = torch.cat([f(2**k * d) for k in range(4) for f in SINES], dim=1)
    feature = trunk(encoded)
    sigma, geometry = field.density(places)
    shown = field.features(geometry, field.encode_directions(d))
    # Angles doubled five times lose five bits; LayerNorm and four layers keep errors in proportion.
    close = {"rtol": 1e-4, "atol": 1e4 * U}
    torch.testing.assert_close(sigma[inside], 21 * opacity(feature)[inside, 0], **close)
    torch.testing.assert_close(2 * shown - 1, colour(torch.cat((feature, seen), dim=1)), **close)


def test_its_step_is_in_voxels(ball_scene, shared_log):
    method = fitted("nsvf", ball_scene, shared_log)
    assert method.how.step == 0.5 / 32
    assert SMALL["nsvf"](step=0.25).sampling(BUDGET).step == 0.25 / 32


def test_embeddings_begin_as_the_teachers_features(ball_scene, shared_log):
    method = SMALL["nsvf"]()
    teacher = train_field(method.teacher, ball_scene, BUDGET, shared_log)
    field = method.begin(teacher, ball_scene, BUDGET).field
    embeddings = field.embeddings.detach()
    assert embeddings.std().item() == pytest.approx(32**-0.5 / math.pi, rel=1e-5)
    places = field.vertices / 32
    learned = encode(places, teacher.field.table.detach(), EXACT_GRID, backend="reference")
    # The same table, read by another backend, and a factor: some roundings.
    scale = 32**-0.5 / math.pi / learned.std()
    torch.testing.assert_close(embeddings, scale * learned, rtol=1e-4, atol=1e-5)


def test_a_teacher_of_other_channels_is_refused():
    with refusal(r"^teacher.grid: expected 32 channels .* got 16", ValueError):
        SMALL["nsvf"](teacher=TEACHER)
