"""The random heap: fixed by its variant, inside its ball, connected, and varied."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch

from bench.scenes.embedded import textures, train_poses
from bench.scenes.embedded.medley import BULKY, CORE, REACH, SHAPES, SMALLER, Draw, medley
from bench.scenes.embedded.raytrace import render
from bench.scenes.embedded.solids import Box, Capsule, Carved, Common, Cylinder, Ellipsoid
from bench.types import Camera

FIRST = range(12)


def test_the_stream_is_the_one_that_python_promises():
    # The sequence of the Mersenne twister from an integer seed is part of Python's interface.
    assert Draw(7).share() == pytest.approx(0.32383276483316237, abs=1e-15)


def test_parts_are_few_and_lie_in_their_ball():
    for variant in range(60):
        model = medley(variant)
        assert 13 <= len(model.parts) <= 16  # 5 in the core, 8 to 11 around it
        assert model.boxes().norm(dim=-1).max() <= REACH * (1 + 1e-5)


def test_pictures_are_filled_and_not_cut():
    focal = 32 / math.tan(0.345)
    for variant in FIRST:
        pose = train_poses(12, variant)[variant].float()
        camera = Camera(pose, focal, focal, 32, 32, 64, 64)
        shown = render(medley(variant), camera, torch.ones(3), 4).alpha
        border = torch.cat((shown[0], shown[-1], shown[:, 0], shown[:, -1]))
        assert (border == 0).all()
        assert 0.06 < shown.mean() < 0.4


def test_the_core_touches_its_first_part():
    for variant in FIRST:
        first, *others = medley(variant).parts[:CORE]
        for part in others:
            # The centre lies on an ellipsoid inside the first part, unless moved to the middle.
            local = (torch.tensor(part.centre) - torch.tensor(first.centre)) @ first.frame
            assert first.shape.distance(local[None]) <= 1e-5


def test_every_solid_and_every_texture_occurs_fine_and_coarse():
    parts = [part for variant in FIRST for part in medley(variant).parts]
    assert {*BULKY, *SMALLER} == SHAPES.keys()
    shapes = {type(part.shape) for part in parts}
    assert shapes == {Box, Capsule, Carved, Common, Cylinder, Ellipsoid}
    makers = {maker.args[0] for maker in vars(textures).values() if isinstance(maker, partial)}
    assert {part.texture.func for part in parts} == makers
    assert len(makers) == 10
    assert {part.gloss > 0 for part in parts} == {True, False}
    thickness = [min(part.shape.extent()) for part in parts]
    assert min(thickness) < 0.01
    assert max(thickness) > 0.3
