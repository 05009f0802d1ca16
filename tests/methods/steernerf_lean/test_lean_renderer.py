"""The lean 2D renderer: against a dense network, its base, how far it sees."""

from __future__ import annotations

from dataclasses import replace

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
    shown_by,
    spot,
)


def reached(observation: Observation, scale: int) -> Tensor:
    """[h, w] bool: cells within REACH of something, a cell at a time."""
    height, width = observation.frame.alpha.shape
    seen = observation.frame.alpha > 0
    for frame in observation.preceding:
        for row, column in (frame.index >= 0).nonzero().tolist():
            seen[row // scale, column // scale] = True
    active = torch.zeros(height, width, dtype=torch.bool)
    for row, column in seen.nonzero().tolist():
        above, left = max(row - REACH, 0), max(column - REACH, 0)
        active[above : row + REACH + 1, left : column + REACH + 1] = True
    return active


def dense(renderer: LeanRenderer, observation: Observation) -> Tensor:
    """The same network on all cells, with dense convolutions of pictures that are masked."""
    scale, background = renderer.scale, observation.background
    active = reached(observation, scale)
    drawn_at = active.repeat_interleave(scale, 0).repeat_interleave(scale, 1)[..., None]
    base = enlarged(observation, scale) - background[:3]

    def planes_of(values: Tensor, known: Tensor) -> Tensor:
        """[C + 1, H, W]: the colours, whether they are known, the rest."""
        parts = (values[..., :3], known[..., None], values[..., 3:])
        return torch.cat(parts, dim=-1).permute(2, 0, 1)

    def in_cells(image: Tensor) -> Tensor:
        """[s^2 C, h, w], the channels of a pixel beside each other."""
        channels = functional.pixel_unshuffle(image[None], scale)[0]
        parts = channels.view(len(image), scale**2, *channels.shape[1:])
        return parts.transpose(0, 1).flatten(0, 1)

    frame = observation.frame
    planes = [planes_of(frame.values - background, frame.alpha)]
    for points in observation.preceding:
        values, known = shown_by(points)
        planes.append(in_cells(planes_of((values - background) * known[..., None], known)))
    if renderer.layout.history:
        picture, known = before(observation, scale)
        recent = (picture - background[:3] - base) * known
        planes.append(in_cells(planes_of(recent, known[..., 0])))
    if renderer.layout.surface:
        values, known = at_surface(observation, scale)
        less, opacity = (values[..., :-1] - background) * known[..., None], values[..., -1] * known
        less[..., :3] -= base * known[..., None]
        planes.append(in_cells(planes_of(less, opacity)))

    def pointwise(x: Tensor, layer: torch.nn.Linear) -> Tensor:
        return functional.conv2d(x, layer.weight[:, :, None, None], layer.bias)

    hidden = pointwise(torch.cat(planes)[None], renderer.network.enter) * active
    for block in renderer.network.trunk:
        kernel = block.spread.T.reshape(-1, 1, 3, 3)
        mixed = functional.conv2d(hidden, kernel, padding=1, groups=len(kernel))
        grown = functional.leaky_relu(pointwise(mixed, block.grow), LEAK)
        hidden = (hidden + pointwise(grown, block.shrink)) * active
    hidden = functional.leaky_relu(hidden, LEAK)
    slots = pointwise(hidden, renderer.network.leave)[0].view(scale**2, -1, *active.shape)
    fine = functional.pixel_shuffle(slots.transpose(0, 1).flatten(0, 1)[None], scale)
    fine = fine[0].permute(1, 2, 0)  # [H, W, 3 or 4]
    drawn = base + fine[..., :3]
    if renderer.layout.history:
        drawn = drawn + fine[..., 3:].sigmoid() * recent
    if renderer.network.read is not None:
        matrices = pointwise(hidden, renderer.network.read)[0]
        matrices = matrices.repeat_interleave(scale, 1).repeat_interleave(scale, 2)
        colours, opacity = less[..., :3] * opacity[..., None], opacity[..., None]
        read = torch.cat((colours, opacity, less[..., 3:]), dim=-1).permute(2, 0, 1)
        drawn = drawn + (matrices.view(3, *read.shape) * read).sum(dim=1).permute(1, 2, 0)
    return torch.where(drawn_at, drawn, 0) + background[:3]


@pytest.mark.parametrize("history", [False, True])
@pytest.mark.parametrize("surface", [False, True])
@pytest.mark.parametrize("share", [0.03, 1.0])
def test_cells_are_drawn_as_by_a_dense_network(history: bool, surface: bool, share: float) -> None:
    matter = torch.rand(12, 14, generator=torch.Generator().manual_seed(2)) < share
    observation = observe(12, 14, matter=matter)
    renderer = shaken(new_renderer(history=history, surface=surface))
    active = reached(observation, 4)
    assert (active.float().mean() < 0.9) == (share < 1)
    want = dense(renderer.double(), doubled(observation))
    assert (want != 1).any()
    got = renderer([doubled(observation)]).pictures[0]
    torch.testing.assert_close(got, want, rtol=0, atol=ROUNDING)
    quick = renderer.float()([observation]).pictures[0]
    torch.testing.assert_close(quick.double(), want, rtol=0, atol=FLOAT32_ERROR)


@pytest.mark.parametrize(
    ("channels", "frames", "scale", "height", "width"),
    [(6, 2, 4, 5, 7), (3, 0, 4, 3, 4), (8, 1, 3, 5, 3), (6, 3, 2, 1, 5), (4, 1, 1, 9, 6)],
)
def test_any_features_frames_and_sizes_are_taken(
    channels: int, frames: int, scale: int, height: int, width: int
) -> None:
    renderer = new_renderer(channels, frames, scale)
    observations = [
        observe(height, width, channels=channels, frames=frames, scale=scale, seed=seed)
        for seed in range(2)
    ]
    for batch in (observations[:1], observations):
        pictures, base = renderer(batch).pictures, renderer.base(batch)
        assert pictures.shape == base.shape == (len(batch), height * scale, width * scale, 3)
        assert pictures.isfinite().all()


def test_frames_that_are_missing_after_a_cold_start_show_nothing() -> None:
    renderer = shaken(new_renderer())
    warm = observe()
    assert warm.history is not None
    assert warm.surface is not None
    nothing = replace(
        warm,
        preceding=[
            warm.preceding[0],
            replace(warm.preceding[1], index=torch.full_like(warm.preceding[1].index, -1)),
        ],
        history=Detail(warm.history.values, torch.zeros_like(warm.history.valid)),
        surface=replace(warm.surface, index=torch.full_like(warm.surface.index, -1)),
    )
    missing = replace(warm, preceding=warm.preceding[:1], history=None, surface=None)
    assert torch.equal(renderer([nothing]).pictures, renderer([missing]).pictures)
    cold = renderer([replace(missing, preceding=[])]).pictures
    assert cold.isfinite().all()
    assert (cold - renderer([missing]).pictures).abs().max() > 1e-3


@pytest.mark.parametrize("history", [False, True])
def test_gradients_reach_every_parameter_and_the_features_of_all_that_is_shown(
    history: bool,
) -> None:
    renderer = shaken(new_renderer(history=history))
    observation = observe(history=history)
    features = [tensor.requires_grad_() for tensor in features_of(observation)]
    assert len(features) == 4  # of the present, two preceding frames, the surface
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
    observation = observe(6, 5, scale=scale, history=history)
    assert observation.surface is not None
    assert (observation.surface.index >= 0).any()
    base = renderer.base([observation])
    # Weights and values are multiples of 1/4096: nothing is rounded.
    assert torch.equal(base[0], enlarged(observation, scale))
    assert torch.equal(renderer([observation]).pictures, base)


def test_the_base_reproduces_a_ramp() -> None:
    height, width, scale = 5, 7, 4
    observation = observe(height, width)
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
    observation = observe(height, width, matter=spot(height, width, 5, 6))
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


def test_a_point_of_a_preceding_frame_alone_is_something() -> None:
    nothing = torch.zeros(9, 9, dtype=torch.bool)
    observation = observe(9, 9, frames=1, matter=nothing)
    renderer = shaken(new_renderer(frames=1))
    index = observation.preceding[0].index.clone()
    index[18, 17] = 3  # in cell (4, 4)
    preceding = [replace(observation.preceding[0], index=index)]
    cells = cells_at_matter(observation.frame.alpha, preceding)
    alone = replace(observation, preceding=preceding, cells=cells, history=None, surface=None)
    seen = renderer([alone]).pictures
    changed = (seen[0] != 1).any(dim=-1).nonzero()
    assert changed.amin(dim=0).tolist() == [4 * (4 - REACH)] * 2
    assert changed.amax(dim=0).tolist() == [4 * (5 + REACH) - 1] * 2


def test_where_nothing_is_the_picture_is_the_background() -> None:
    observation = observe(matter=torch.zeros(5, 7, dtype=torch.bool))
    renderer = shaken(new_renderer())
    assert (renderer([observation]).pictures == 1).all()
    assert (renderer.base([observation]) == 1).all()
    for empty in (observation, replace(observation, preceding=[], history=None, surface=None)):
        renderer([empty]).pictures.sum().backward()  # a patch without matter stops no training


@pytest.mark.parametrize(("row", "column"), [(5, 6), (0, 0), (12, 13)])
def test_a_batch_of_two_is_one_after_the_other(row: int, column: int) -> None:
    observations = [
        doubled(observe(14, 16, matter=spot(14, 16, row, column))),
        doubled(observe(14, 16, matter=spot(14, 16, 3, 3), seed=1)),
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
    observation = doubled(observe(size, size, matter=matter))
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
    observation = observe(size, size, frames=0, surface=False, matter=spot(size, size, 5, 5))
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
    observations = [observe(9, 9, matter=spot(9, 9, 3, 3)), observe(9, 9, seed=1)]
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
    renderer, observation = shaken(new_renderer()), observe(20, 14, matter=matter)
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
    observation = observe()
    with torch.autocast("cpu", torch.bfloat16):
        half = renderer([observation]).pictures
        assert torch.equal(renderer.base([observation]), new_renderer().base([observation]))
    assert half.dtype == torch.float32
    # A correction below 1, of sums of which each term is off by 1/256.
    assert 0 < (half - renderer([observation]).pictures).abs().max() < 0.1
