"""What the lean 2D renderer takes from the preceding picture, the surface and preceding points."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.methods.observations import (
    BACKGROUND,
    FLOAT32_ERROR,
    at_surface,
    before,
    enlarged,
    new_renderer,
    observe,
    shaken,
)

BLENDING = 6 * 2.0**-24
"""Error of base + share (other - base), less the background and with it again, of size 1."""


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_preceding_picture_is_blended_in_where_it_is_known(share: float) -> None:
    scale = 4
    renderer = new_renderer()
    with torch.no_grad():
        renderer.network.leave.bias.view(scale**2, 4)[:, 3] = 40.0 if share else -200.0
    observation = observe()
    picture, valid = before(observation, scale)
    base = enlarged(observation, scale)
    want = torch.where(valid > 0, share * picture + (1 - share) * base, base)
    assert 0.5 < valid.mean() < 0.8
    torch.testing.assert_close(renderer([observation]).pictures[0], want, rtol=0, atol=BLENDING)


def test_the_surface_covers_the_base_as_far_as_it_is_opaque() -> None:
    """Where the matrix of every cell is the identity on RGB and looks at nothing else."""
    scale, channels = 4, 6
    renderer = new_renderer(channels, history=False)
    assert renderer.network.read is not None
    with torch.no_grad():
        renderer.network.read.bias.view(3, channels + 1)[:, :3] = torch.eye(3)
    observation = observe(channels=channels)
    values, known = at_surface(observation, scale)
    base = enlarged(observation, scale)
    covered = base + values[..., -1:] * (values[..., :3] - base)
    want = torch.where(known[..., None] > 0, covered, base)
    assert 0.5 < known.mean() < 0.8
    torch.testing.assert_close(renderer([observation]).pictures[0], want, rtol=0, atol=BLENDING)


@pytest.mark.parametrize("column", [3, 4, 6])
def test_a_matrix_reads_opacity_and_other_features_less_the_background(column: int) -> None:
    """Of K = 6: the opacity is behind the colours, then come the others."""
    scale, channels = 4, 6
    renderer = new_renderer(channels, history=False)
    assert renderer.network.read is not None
    with torch.no_grad():
        renderer.network.read.bias.view(3, channels + 1)[1, column] = 1.0  # into green
    observation = observe(channels=channels)
    values, known = at_surface(observation, scale)
    read = values[..., -1] if column == 3 else values[..., column - 1] - BACKGROUND[column - 1]
    want = enlarged(observation, scale)
    want[..., 1] += known * read
    torch.testing.assert_close(renderer([observation]).pictures[0], want, rtol=0, atol=BLENDING)


@pytest.mark.parametrize("part", ["history", "surface"])
def test_a_renderer_without_a_part_ignores_what_is_known_of_it(part: str) -> None:
    renderer = shaken(new_renderer(**{part: False}))
    observation = observe()
    without = replace(observation, **{part: None})
    assert torch.equal(renderer([observation]).pictures, renderer([without]).pictures)
    other = shaken(new_renderer())
    assert not torch.equal(other([observation]).pictures, other([without]).pictures)


def test_without_preceding_frames_there_is_no_preceding_picture() -> None:
    assert not new_renderer(frames=0).layout.history
    assert new_renderer(frames=0).layout.surface


def test_a_point_that_looks_like_the_background_is_not_nothing() -> None:
    observation = observe(frames=1)
    renderer = shaken(new_renderer(frames=1))
    like_background = replace(observation.preceding[0], values=BACKGROUND[:6].expand(20, 6))
    none = replace(like_background, index=torch.full_like(like_background.index, -1))
    shown, hidden = (
        renderer([replace(observation, preceding=[p])]).pictures for p in (like_background, none)
    )
    assert (shown - hidden).abs().max() > FLOAT32_ERROR
