"""The 2D neural renderers: their sizes, their bases, and that a part is drawn as the whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn import functional

from methods.renderer2d import (
    REACH,
    History,
    Observation,
    Renderer2d,
    Reprojected,
    SpaceToDepth,
    UnetRelease,
)
from methods.volume import FeatureFrame
from tests.methods.conftest import look_at_the_middle

CAMERA = look_at_the_middle(0.0, 0.0)  # no renderer looks at it
BACKGROUND = torch.tensor([1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5])
CONV_ERROR = 1e-5
"""Activations of size 1 to 10, sums of up to 2,000 products in another order: a few tens of u, a
few layers deep."""

Make = Callable[..., Renderer2d]
RENDERERS: list[Make] = [UnetRelease, SpaceToDepth]


def observe(
    height: int = 5,
    width: int = 7,
    *,
    channels: int = 6,
    frames: int = 2,
    scale: int = 4,
    matter: Tensor | None = None,
    history: bool = True,
    phase: tuple[float, float] = (0.0, 0.0),
    seed: int = 0,
) -> Observation:
    """Random features in steps of 1/256 where there is `matter` [h, w], the background elsewhere.

    Preceding points land on a third of the pixels of cells with matter, and the preceding picture
    is known in two thirds of them.
    """
    generator = torch.Generator().manual_seed(seed)
    if matter is None:
        matter = torch.ones(height, width, dtype=torch.bool)
    background = BACKGROUND[:channels]
    values = torch.randint(257, (height, width, channels), generator=generator) / 256
    values = torch.where(matter[..., None], values, background)
    fine = matter.repeat_interleave(scale, 0).repeat_interleave(scale, 1)
    preceding = []
    for _ in range(frames):
        points = torch.rand(20, channels, generator=generator)
        index = torch.randint(-1, 20, fine.shape, generator=generator, dtype=torch.int32)
        shown = fine & (torch.rand(fine.shape, generator=generator) < 0.3)
        preceding.append(Reprojected(points, torch.where(shown, index, -1)))
    known = None
    if history:
        valid = torch.rand(height, width, scale**2, generator=generator) < 0.66
        valid = (valid & matter[..., None]).float()
        picture = torch.rand(height, width, scale**2, 3, generator=generator)
        known = History(picture * valid[..., None], valid)
    frame = FeatureFrame(CAMERA, values, torch.where(matter, 1.5, torch.inf), matter.float())
    return Observation(frame, background, preceding, known, phase)


def spot(height: int, width: int, row: int, column: int) -> Tensor:
    matter = torch.zeros(height, width, dtype=torch.bool)
    matter[row : row + 2, column : column + 3] = True
    return matter


def cut(observation: Observation, scale: int, rows: slice, columns: slice) -> Observation:
    """The low-resolution pixels `rows` x `columns` of an observation, and all that is in them."""
    fine = tuple(slice(scale * part.start, scale * part.stop) for part in (rows, columns))
    frame, history = observation.frame, observation.history
    return replace(
        observation,
        frame=replace(
            frame,
            values=frame.values[rows, columns],
            depth=frame.depth[rows, columns],
            alpha=frame.alpha[rows, columns],
        ),
        preceding=[replace(p, index=p.index[fine]) for p in observation.preceding],
        history=history and History(history.values[rows, columns], history.valid[rows, columns]),
    )


def shaken(renderer: Renderer2d, seed: int = 0) -> Renderer2d:
    """The renderer with a last layer that is not 0, as after some training."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in renderer.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=generator))
    return renderer


def blocks_to_picture(blocks: Tensor, scale: int) -> Tensor:
    """[h, w, s^2, 3] to [h s, w s, 3]."""
    height, width = blocks.shape[:2]
    parts = blocks.view(height, width, scale, scale, 3).transpose(1, 2)
    return parts.reshape(height * scale, width * scale, 3)


@pytest.mark.parametrize(("frames", "count"), [(0, 2_108_675), (1, 2_112_131), (2, 2_115_587)])
def test_the_released_network_has_its_number_of_parameters(frames: int, count: int) -> None:
    renderer = UnetRelease(6, frames, 4)
    assert sum(parameter.numel() for parameter in renderer.parameters()) == count


@pytest.mark.parametrize("make", RENDERERS)
@pytest.mark.parametrize(
    ("channels", "frames", "scale", "height", "width"),
    [(6, 2, 4, 5, 7), (3, 0, 4, 3, 4), (8, 1, 3, 5, 3), (6, 3, 2, 3, 5), (4, 1, 1, 9, 6)],
)
def test_any_features_frames_and_sizes_are_taken(
    make: Make, channels: int, frames: int, scale: int, height: int, width: int
) -> None:
    renderer = make(channels, frames, scale)
    observations = [
        observe(height, width, channels=channels, frames=frames, scale=scale, seed=seed)
        for seed in range(2)
    ]
    for batch in (observations[:1], observations):
        pictures, base = renderer(batch)
        assert pictures.shape == base.shape == (len(batch), height * scale, width * scale, 3)
        assert pictures.isfinite().all()


@pytest.mark.parametrize("make", RENDERERS)
def test_frames_that_are_missing_after_a_cold_start_show_nothing(make: Make) -> None:
    renderer = shaken(make(6, 2, 4)).eval()
    warm = observe(frames=2, history=False)
    empty = replace(warm.preceding[1], index=torch.full_like(warm.preceding[1].index, -1))
    pictures, _ = renderer([replace(warm, preceding=warm.preceding[:1])])
    unseen, _ = renderer([replace(warm, preceding=[warm.preceding[0], empty])])
    torch.testing.assert_close(pictures, unseen, rtol=0, atol=CONV_ERROR)
    cold, _ = renderer([replace(warm, preceding=[])])
    assert cold.isfinite().all()
    assert (cold - pictures).abs().max() > 100 * CONV_ERROR


@pytest.mark.parametrize("make", RENDERERS)
def test_gradients_reach_every_parameter_and_the_features_of_all_frames(make: Make) -> None:
    renderer = shaken(make(6, 2, 4))
    observation = observe()
    features = [observation.frame.values, *(p.values for p in observation.preceding)]
    for tensor in features:
        tensor.requires_grad_()
    pictures, _ = renderer([observation])
    pictures.square().sum().backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
    for tensor in features:
        assert tensor.grad is not None
        assert tensor.grad.any(dim=0).all()  # every channel, RGB and others


@pytest.mark.parametrize("aligned", [False, True])
def test_the_base_of_the_release_puts_the_corners_on_corners_or_centres(aligned: bool) -> None:
    height, width, scale = 4, 6, 4
    observation = observe(height, width, frames=0, history=False)
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    observation.frame.values[..., 0], observation.frame.values[..., 1] = row / 8, column / 8
    _, base = UnetRelease(6, 0, scale, aligned=aligned)([observation])
    for channel, size in ((0, height), (1, width)):
        pixel = torch.arange(size * scale)
        if aligned:
            place = ((pixel + 0.5) / scale - 0.5).clamp(0, size - 1)
        else:
            place = pixel * (size - 1) / (size * scale - 1)
        ramp = base[0, :, 0, 0] if channel == 0 else base[0, 0, :, 1]
        torch.testing.assert_close(ramp, place / 8, rtol=0, atol=1e-6)


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_an_untrained_network_draws_the_aligned_bilinear_base(scale: int) -> None:
    renderer = SpaceToDepth(6, 2, scale)
    observation = observe(scale=scale, history=False)
    pictures, base = renderer([observation])
    rgb = observation.frame.values[..., :3].permute(2, 0, 1)[None]
    want = functional.interpolate(
        rgb, scale_factor=scale, mode="bilinear", align_corners=False
    ).permute(0, 2, 3, 1)
    # Weights and values are multiples of 1/4096: nothing is rounded.
    assert torch.equal(base, want)
    assert torch.equal(pictures, base)


@pytest.mark.parametrize("phase", [(0.0, 0.0), (1.5, -0.5), (-1.5, 1.5), (2.0, -2.0)])
def test_the_base_reproduces_a_ramp_at_any_phase(phase: tuple[float, float]) -> None:
    height, width, scale = 5, 7, 4
    observation = observe(height, width, frames=0, history=False, phase=phase)
    across = scale * (torch.arange(width) + 0.5) + phase[0]
    down = scale * (torch.arange(height) + 0.5) + phase[1]
    observation.frame.values[..., 0] = across / 64
    observation.frame.values[..., 1] = down[:, None] / 64
    observation.frame.values[..., 2] = (2 * down[:, None] - across) / 64
    _, base = SpaceToDepth(6, 0, scale)([observation])
    # Within the samples; beyond the outermost ones the border is repeated.
    u, v = torch.arange(width * scale) + 0.5, torch.arange(height * scale) + 0.5
    columns = ((u >= across[0]) & (u <= across[-1])).nonzero().squeeze(1)
    rows = ((v >= down[0]) & (v <= down[-1])).nonzero().squeeze(1)
    x, y = u[columns][None, :], v[rows][:, None]
    want = torch.stack((x + 0 * y, y + 0 * x, 2 * y - x), dim=-1) / 64
    assert torch.equal(base[0][rows][:, columns], want)
    assert (base[0, :, 0, 0] <= across[1] / 64).all()


@pytest.mark.parametrize("batch", [1, 2])
def test_far_from_anything_the_picture_is_the_background(batch: int) -> None:
    height, width, scale = 14, 16, 4
    observation = observe(height, width, matter=spot(height, width, 5, 6))
    pictures, base = shaken(SpaceToDepth(6, 2, scale))([observation] * batch)
    reached = torch.zeros(height * scale, width * scale, dtype=torch.bool)
    rows = slice(scale * (5 - REACH), scale * (7 + REACH))
    columns = slice(scale * (6 - REACH), scale * (9 + REACH))
    reached[rows, columns] = True
    for picture in (*pictures, *base):
        assert (picture[~reached] == BACKGROUND[:3]).all()
    assert ((pictures[0] != BACKGROUND[:3]).any(dim=-1) == reached).float().mean() > 0.99


def test_a_point_of_a_preceding_frame_alone_is_something() -> None:
    nothing = torch.zeros(9, 9, dtype=torch.bool)
    observation = observe(9, 9, frames=1, history=False, matter=nothing)
    renderer = shaken(SpaceToDepth(6, 1, 4))
    empty, _ = renderer([observation])
    assert (empty == 1).all()
    index = observation.preceding[0].index.clone()
    index[18, 17] = 3  # in cell (4, 4)
    seen, _ = renderer(
        [replace(observation, preceding=[replace(observation.preceding[0], index=index)])]
    )
    changed = (seen[0] != 1).any(dim=-1).nonzero()
    assert changed.amin(dim=0).tolist() == [4 * (4 - REACH)] * 2
    assert changed.amax(dim=0).tolist() == [4 * (5 + REACH) - 1] * 2


@pytest.mark.parametrize(("row", "column"), [(5, 6), (0, 0), (12, 13)])
def test_the_box_around_what_is_seen_changes_nothing(row: int, column: int) -> None:
    """One observation is drawn in the box around its matter, of two the whole frame is."""
    observation = observe(14, 16, matter=spot(14, 16, row, column))
    renderer = shaken(SpaceToDepth(6, 2, 4, blocks=2))
    alone, alone_base = renderer([observation])
    both, both_base = renderer([observation, observe(14, 16, seed=1)])
    torch.testing.assert_close(alone[0], both[0], rtol=0, atol=CONV_ERROR)
    torch.testing.assert_close(alone_base[0], both_base[0], rtol=0, atol=CONV_ERROR)


def test_a_patch_is_drawn_as_the_whole_frame() -> None:
    blocks, scale, size = 2, 4, 24
    # The first and the last convolution and two in a block reach a pixel further each; activations
    # depend on whether anything is within REACH of where the first convolution has its output.
    halo = max(2 * blocks + 2, 2 * blocks + 1 + REACH)
    matter = torch.rand(size, size, generator=torch.Generator().manual_seed(5)) < 0.05
    observation = observe(size, size, matter=matter)
    renderer = shaken(SpaceToDepth(6, 2, scale, blocks=blocks))
    whole, whole_base = renderer([observation])
    begin, end = 9, 15
    side = slice(begin - halo, end + halo)
    patch, patch_base = renderer([cut(observation, scale, side, side)] * 2)
    inside = slice(scale * halo, scale * (halo + end - begin))
    there = slice(scale * begin, scale * end)
    assert (whole[0, there, there] != 1).any()
    for got, want in ((patch, whole), (patch_base, whole_base)):
        torch.testing.assert_close(
            got[0, inside, inside], want[0, there, there], rtol=0, atol=CONV_ERROR
        )


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_preceding_picture_is_blended_in_where_it_is_known(share: float) -> None:
    scale = 4
    renderer = SpaceToDepth(6, 2, scale)
    with torch.no_grad():
        renderer.last.bias[3 * scale**2 :] = 40.0 if share else -200.0
    observation = observe()
    assert observation.history is not None
    pictures, base = renderer([observation])
    valid = blocks_to_picture(observation.history.valid[..., None].expand(-1, -1, -1, 3), scale)
    old = blocks_to_picture(observation.history.values, scale)
    want = torch.where(valid > 0, share * old + (1 - share) * base[0], base[0])
    assert 0.5 < valid.mean() < 0.8
    # base + (old - base), of size 1.
    torch.testing.assert_close(pictures[0], want, rtol=0, atol=4 * 2.0**-24)


def test_a_renderer_without_history_ignores_it() -> None:
    renderer = shaken(SpaceToDepth(6, 2, 4, history=False))
    observation = observe()
    with_it, _ = renderer([observation])
    without, _ = renderer([replace(observation, history=None)])
    assert torch.equal(with_it, without)
    assert not SpaceToDepth(6, 0, 4).history  # no preceding frame, no preceding picture


def test_a_network_that_is_told_of_validity_knows_background_from_nothing() -> None:
    """A point with the features of the background differs from no point only by that."""
    observation = observe(frames=1, history=False)
    told = shaken(SpaceToDepth(6, 1, 4)), shaken(SpaceToDepth(6, 1, 4, validity=False))
    like_background = Reprojected(BACKGROUND[:6].expand(20, 6), observation.preceding[0].index)
    none = Reprojected(like_background.values, torch.full_like(like_background.index, -1))
    for renderer, differs in zip(told, (True, False), strict=True):
        shown, _ = renderer([replace(observation, preceding=[like_background])])
        hidden, _ = renderer([replace(observation, preceding=[none])])
        assert ((shown - hidden).abs().max() > CONV_ERROR) == differs
