"""The lean 2D renderer: against a dense network, its base, how far it sees."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from methods.steernerf.renderer import Detail, Observation, cells_at_matter
from methods.steernerf_lean.cell_network import LEAK
from methods.steernerf_lean.cells import REACH
from methods.steernerf_lean.lean_renderer import LeanRenderer
from tests.methods.observations import (
    BACKGROUND,
    FLOAT32_ERROR,
    ROUNDING,
    at_surface,
    before,
    cut,
    doubled,
    enlarged,
    features_of,
    new_renderer,
    observe,
    shaken,
    spot,
)

observed = partial(observe, frames=0)


def reached(observation: Observation) -> Tensor:
    """[h, w] bool: cells within REACH of matter, a cell at a time."""
    seen = observation.frame.alpha > 0
    active = torch.zeros_like(seen)
    for row, column in seen.nonzero().tolist():
        above, left = max(row - REACH, 0), max(column - REACH, 0)
        active[above : row + REACH + 1, left : column + REACH + 1] = True
    return active


def dense(renderer: LeanRenderer, observation: Observation) -> Tensor:
    """The same network on all cells, with dense convolutions of pictures that are masked."""
    scale, background = renderer.scale, observation.background
    active = reached(observation)
    drawn_at = active.repeat_interleave(scale, 0).repeat_interleave(scale, 1)[..., None]
    base = enlarged(observation, scale) - background[:3]

    def in_cells(image: Tensor) -> Tensor:
        """[s^2 C, h, w] of [H, W, C], the channels of a pixel beside each other."""
        channels = functional.pixel_unshuffle(image.permute(2, 0, 1)[None], scale)[0]
        parts = channels.view(image.shape[2], scale**2, *channels.shape[1:])
        return parts.transpose(0, 1).flatten(0, 1)

    frame = observation.frame
    less = frame.values - background
    present = torch.cat((less[..., :3], frame.alpha[..., None], less[..., 3:]), dim=-1)
    planes = [present.permute(2, 0, 1)]
    if renderer.layout.history:
        picture, known = before(observation, scale)
        recent = (picture - background[:3] - base) * known
        planes += [in_cells(recent), in_cells(known)]
    if renderer.layout.surface:
        values, known = at_surface(observation, scale)
        less = (values[..., :-1] - background) * known[..., None]
        opacity = values[..., -1:] * known[..., None]
        less[..., :3] -= base * known[..., None]
        planes += [in_cells(x) for x in (less[..., :3], opacity, less[..., 3:])]

    def pointwise(x: Tensor, layer: torch.nn.Linear) -> Tensor:
        return functional.conv2d(x, layer.weight[:, :, None, None], layer.bias)

    hidden = pointwise(torch.cat(planes)[None], renderer.network.enter) * active
    for block in renderer.network.trunk:
        kernel = block.spread.T.reshape(-1, 1, 3, 3)
        mixed = functional.conv2d(hidden, kernel, padding=1, groups=len(kernel))
        grown = functional.leaky_relu(pointwise(mixed, block.grow), LEAK)
        hidden = (hidden + pointwise(grown, block.shrink)) * active
    hidden = functional.leaky_relu(hidden, LEAK)

    def of_pixels(planes: Tensor) -> Tensor:
        """[H, W, C] of [s^2 C, h, w]."""
        slots = planes.view(scale**2, -1, *active.shape).transpose(0, 1).flatten(0, 1)
        return functional.pixel_shuffle(slots[None], scale)[0].permute(1, 2, 0)

    left = pointwise(hidden, renderer.network.leave)[0]
    drawn = base + of_pixels(left[: 3 * scale**2])
    if renderer.layout.history:
        drawn = drawn + of_pixels(left[3 * scale**2 :]).sigmoid() * recent
    if renderer.network.read is not None:
        matrices = pointwise(hidden, renderer.network.read)[0]
        matrices = matrices.repeat_interleave(scale, 1).repeat_interleave(scale, 2)
        read = torch.cat((less[..., :3] * opacity, opacity, less[..., 3:]), dim=-1)
        read = read.permute(2, 0, 1)
        drawn = drawn + (matrices.view(3, *read.shape) * read).sum(dim=1).permute(1, 2, 0)
    return torch.where(drawn_at, drawn, 0) + background[:3]


@pytest.mark.parametrize("history", [False, True])
@pytest.mark.parametrize("surface", [False, True])
@pytest.mark.parametrize("share", [0.03, 1.0])
def test_cells_are_drawn_as_by_a_dense_network(history: bool, surface: bool, share: float) -> None:
    matter = torch.rand(12, 14, generator=torch.Generator().manual_seed(2)) < share
    observation = observed(12, 14, matter=matter)
    renderer = shaken(new_renderer(history=history, surface=surface))
    active = reached(observation)
    assert (active.float().mean() < 0.9) == (share < 1)
    want = dense(renderer.double(), doubled(observation))
    assert (want != 1).any()
    got = renderer([doubled(observation)]).pictures[0]
    torch.testing.assert_close(got, want, rtol=0, atol=ROUNDING)
    quick = renderer.float()([observation]).pictures[0]
    torch.testing.assert_close(quick.double(), want, rtol=0, atol=FLOAT32_ERROR)


@pytest.mark.parametrize(
    ("channels", "scale", "height", "width"),
    [(6, 4, 5, 7), (3, 4, 3, 4), (8, 3, 5, 3), (4, 1, 1, 9)],
)
def test_any_features_and_sizes_are_taken(
    channels: int, scale: int, height: int, width: int
) -> None:
    renderer = new_renderer(channels, scale=scale)
    observations = [
        observed(height, width, channels=channels, scale=scale, seed=seed) for seed in range(2)
    ]
    for batch in (observations[:1], observations):
        pictures, base = renderer(batch).pictures, renderer.base(batch)
        assert pictures.shape == base.shape == (len(batch), height * scale, width * scale, 3)
        assert pictures.isfinite().all()


def test_a_picture_and_a_surface_that_are_missing_show_nothing() -> None:
    renderer, warm = shaken(new_renderer()), observed()
    assert warm.history is not None
    assert warm.surface is not None
    nothing = replace(
        warm,
        history=Detail(warm.history.values, torch.zeros_like(warm.history.valid)),
        surface=replace(warm.surface, index=torch.full_like(warm.surface.index, -1)),
    )
    cold = renderer([replace(warm, history=None, surface=None)]).pictures
    assert torch.equal(renderer([nothing]).pictures, cold)
    assert (renderer([warm]).pictures - cold).abs().max() > 1e-3


@pytest.mark.parametrize("history", [False, True])
def test_gradients_reach_every_parameter_and_the_features_of_all_that_is_shown(
    history: bool,
) -> None:
    renderer = shaken(new_renderer(history=history))
    observation = observed(history=history)
    features = [tensor.requires_grad_() for tensor in features_of(observation)]
    assert len(features) == 2  # of the present and the surface
    drawing = renderer([observation])
    assert drawing.error is not None
    (drawing.pictures.square().sum() + drawing.error.sum()).backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
    for tensor in features:
        assert tensor.grad is not None
        assert tensor.grad.any(dim=0).all()  # every channel, RGB and others


@pytest.mark.parametrize("scale", [1, 2, 4])
@pytest.mark.parametrize("history", [False, True])
def test_an_untrained_network_draws_the_aligned_bilinear_base(history: bool, scale: int) -> None:
    """Whatever is at the surface. A preceding picture is blended in half and half, so there is
    none, or none that the network looks at."""
    renderer = new_renderer(scale=scale, history=not history)
    observation = observed(6, 5, scale=scale, history=history)
    assert observation.surface is not None
    assert (observation.surface.index >= 0).any()
    base = renderer.base([observation])
    # Weights and values are multiples of 1/4096: nothing is rounded.
    assert torch.equal(base[0], enlarged(observation, scale))
    assert torch.equal(renderer([observation]).pictures, base)


def test_the_base_reproduces_a_ramp() -> None:
    height, width, scale = 5, 7, 4
    observation = observed(height, width)
    across = scale * (torch.arange(width) + 0.5)
    down = scale * (torch.arange(height) + 0.5)
    observation.frame.values[..., 0] = across / 64
    observation.frame.values[..., 1] = down[:, None] / 64
    observation.frame.values[..., 2] = (2 * down[:, None] - across) / 64
    base = new_renderer().base([observation])
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
    observation = observed(height, width, matter=spot(height, width, 5, 6))
    renderer = shaken(new_renderer())
    pictures, base = renderer([observation] * batch).pictures, renderer.base([observation] * batch)
    near = torch.zeros(height * scale, width * scale, dtype=torch.bool)
    rows = slice(scale * (5 - REACH), scale * (7 + REACH))
    columns = slice(scale * (6 - REACH), scale * (9 + REACH))
    near[rows, columns] = True
    for picture in (*pictures, *base):
        assert (picture[~near] == BACKGROUND[:3]).all()
    assert ((pictures[0] != BACKGROUND[:3]).any(dim=-1) == near).float().mean() > 0.99
    assert torch.equal(base[0][near], enlarged(observation, scale)[near])


def test_where_nothing_is_the_picture_is_the_background() -> None:
    observation = observed(matter=torch.zeros(5, 7, dtype=torch.bool))
    renderer = shaken(new_renderer())
    assert (renderer([observation]).pictures == 1).all()
    assert (renderer.base([observation]) == 1).all()
    for empty in (observation, replace(observation, history=None, surface=None)):
        renderer([empty]).pictures.sum().backward()  # a patch without matter stops no training


@pytest.mark.parametrize(("row", "column"), [(5, 6), (0, 0), (12, 13)])
def test_a_batch_of_two_is_one_after_the_other(row: int, column: int) -> None:
    observations = [
        doubled(observed(14, 16, matter=spot(14, 16, row, column))),
        doubled(observed(14, 16, matter=spot(14, 16, 3, 3), seed=1)),
    ]
    renderer = shaken(new_renderer()).double()
    for draw in (lambda shown: renderer(shown).pictures, renderer.base):
        alone = torch.cat([draw([observation]) for observation in observations])
        torch.testing.assert_close(draw(observations), alone, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("blocks", [1, 3])
def test_a_patch_is_drawn_as_the_whole_frame(blocks: int) -> None:
    """A cell sees as far as there are blocks, and whether the last one it sees is there depends on
    what is within REACH of that."""
    scale, size = 4, 24
    halo = blocks + REACH
    matter = torch.rand(size, size, generator=torch.Generator().manual_seed(5)) < 0.03
    observation = doubled(observed(size, size, matter=matter))
    renderer = shaken(new_renderer(blocks=blocks)).double()
    begin, end = 9, 15
    side = slice(begin - halo, end + halo)
    patch = cut(observation, scale, side, side)
    inside = slice(scale * halo, scale * (halo + end - begin))
    there = slice(scale * begin, scale * end)
    for draw in (lambda shown: renderer(shown).pictures, renderer.base):
        want = draw([observation])[0, there, there]
        assert (want != 1).any()
        got = draw([patch])[0, inside, inside]
        torch.testing.assert_close(got, want, rtol=0, atol=ROUNDING)


def test_a_cell_sees_as_far_as_a_patch_has_to_reach() -> None:
    """Whether something is `blocks + REACH` away decides whether the cell `blocks` away is there.

    The cell between them is there in either case, because of what is in the first.
    """
    assert REACH == 1
    blocks, size = 2, 12
    observation = observed(size, size, surface=False, matter=spot(size, size, 5, 5))
    renderer = shaken(new_renderer(frames=0, blocks=blocks, surface=False)).double()
    middle = 0, slice(20, 24), slice(20, 24)  # cell (5, 5)
    without = renderer([doubled(observation)]).pictures[middle]
    for away, seen in ((blocks + REACH, True), (blocks + REACH + 1, False)):
        alpha = observation.frame.alpha.clone()
        alpha[5 - away, 5] = 1e-6
        frame = replace(observation.frame, alpha=alpha)
        changed = replace(observation, frame=frame, cells=cells_at_matter(alpha, []))
        difference = (renderer([doubled(changed)]).pictures[middle] - without).abs().max()
        assert (difference > ROUNDING) == seen


def test_an_error_is_estimated_for_each_cell_of_each_observation() -> None:
    observations = [observed(9, 9, matter=spot(9, 9, 3, 3)), observed(9, 9, seed=1)]
    renderer = shaken(new_renderer())
    error = renderer(observations).error
    assert error is not None
    assert error.shape == (len(observations[0].cells) + len(observations[1].cells),)
    alone = renderer(observations[1:]).error
    assert alone is not None
    assert alone.std() > 0
    torch.testing.assert_close(error[-len(alone) :], alone, rtol=0, atol=FLOAT32_ERROR)


@pytest.mark.parametrize("share", [0.03, 1.0])
def test_without_gradient_the_same_is_drawn(share: float) -> None:
    """Where products are convolutions, of another order of sums."""
    matter = torch.rand(20, 14, generator=torch.Generator().manual_seed(2)) < share
    renderer, observation = shaken(new_renderer()), observed(20, 14, matter=matter)
    want = renderer([observation])
    with torch.no_grad():
        got = renderer([observation])
    torch.testing.assert_close(got.pictures, want.pictures, rtol=0, atol=FLOAT32_ERROR)
    torch.testing.assert_close(got.error, want.error, rtol=0, atol=FLOAT32_ERROR)


def test_its_products_are_those_that_torch_counts_and_nine_for_each_channel_of_a_block() -> None:
    width, blocks, cells = 16, 2, 5
    network = LeanRenderer(6, 2, 4, width=width, blocks=blocks, init="scratch").network
    inputs = torch.zeros(cells, network.enter.in_features), torch.full((cells, 9), -1)
    with FlopCounterMode(display=False) as counter:
        network(*inputs)
    taps = cells * blocks * 9 * width  # sums, which torch does not count
    assert network.products(*inputs) == counter.get_total_flops() // 2 + taps


def test_half_precision_changes_little() -> None:
    renderer = shaken(new_renderer())
    observation = observed()
    with torch.autocast("cpu", torch.bfloat16):
        half = renderer([observation]).pictures
        assert torch.equal(renderer.base([observation]), new_renderer().base([observation]))
    assert half.dtype == torch.float32
    # A correction below 1, of sums of which each term is off by 1/256.
    assert 0 < (half - renderer([observation]).pictures).abs().max() < 0.1
