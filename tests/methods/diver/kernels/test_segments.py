"""Pixels of corner features: counts, chunks, types and shapes; accuracy is in its cases."""

import pytest
import torch

from bench.types import Rays
from methods.diver.kernels.segments import Layers, cases, reference, render_segments
from tests.common import assert_near, refusal

RAYS = 40


def given() -> tuple:
    """A small scene with some rays."""
    scene = cases.scene(cases.SIDE, RAYS, torch.float32, 0.0, 0.0)
    return tuple(scene[name] for name in ("rays", "corners", "layers", "towards"))


def test_backends_count_the_same_segments():
    """In front of the end of a ray, and of a weight that shows; none lies at a bound by chance."""
    counts = [
        render_segments(*given(), stop=0.5, faint=0.1, backend=backend)[1:]
        for backend in ("reference", "cpu")
    ]
    for one, other in zip(*counts, strict=True):
        assert torch.equal(one, other)
    whole, _ = render_segments(*given(), stop=0.0)[1:]
    crossed, shaded = counts[0]
    assert (shaded <= crossed).all()
    assert (crossed <= whole).all()
    assert shaded.sum() < crossed.sum() < whole.sum()


@pytest.mark.parametrize("size", [1, 7, RAYS])
def test_rays_that_are_rendered_in_chunks_have_the_same_pixels(size, monkeypatch):
    together = render_segments(*given(), stop=1e-2, backend="reference")
    monkeypatch.setattr(reference, "CHUNK_RAYS", size)
    apart = render_segments(*given(), stop=1e-2, backend="reference")
    # Products of other shapes are summed in another order: at most 32 roundings of numbers below 1.
    assert_near(apart[0].values, together[0].values, atol=1e-5)
    assert torch.equal(apart[1], together[1])


def test_a_cpu_refuses_what_it_has_no_code_for():
    rays, corners, layers, towards = given()
    wide = Rays(rays.origins.double(), rays.directions.double())
    with refusal("computes with float32", ValueError):
        render_segments(wide, corners, layers, towards, stop=0.0, backend="cpu")
    narrow = Layers(*map(torch.zeros, ((8, 32), 8, (1, 8), 1, (8, 8), (3, 8), 3)))
    with refusal(r"multiples of 16, got \[8, 32\]", ValueError):
        render_segments(rays, corners, narrow, towards[:, :8], stop=0.0, backend="cpu")
