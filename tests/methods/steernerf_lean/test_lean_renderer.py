"""The lean 2D renderer: against a dense network, what it takes from each input, how far it sees,
and how it starts from the weights of another."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional
from torch.utils.flop_counter import FlopCounterMode

from methods.steernerf_lean import lean_renderer
from methods.steernerf_lean.lean_renderer import (
    LEAK,
    PRETRAINED,
    PRETRAINED_LAYOUT,
    LeanRenderer,
)
from methods.steernerf_lean.observation import LeanObservation
from tests.methods.observations import (
    FLOAT32_ERROR,
    ROUNDING,
    at_surface,
    before,
    doubled,
    enlarged,
    everywhere,
    new_renderer,
    observe,
    shaken,
    spot,
)

BLENDING = 6 * 2.0**-24
"""Error of base + share (other - base), less the background and with it again, of size 1."""


def dense(renderer: LeanRenderer, observation: LeanObservation) -> Tensor:
    """The same network on all cells, with dense convolutions of pictures that are masked."""
    scale, background = renderer.layout.scale, observation.background
    active = everywhere(torch.ones(len(observation.cells)), observation) > 0
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
    values, known = at_surface(observation, scale)
    less = (values[..., :-1] - background) * known[..., None]
    opacity = values[..., -1:] * known[..., None]
    less[..., :3] -= base * known[..., None]
    planes += [in_cells(x) for x in (less[..., :3], opacity, less[..., 3:]) if x.numel()]

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
    matrices = pointwise(hidden, renderer.network.read)[0]
    matrices = matrices.repeat_interleave(scale, 1).repeat_interleave(scale, 2)
    read = torch.cat((less[..., :3] * opacity, opacity, less[..., 3:]), dim=-1).permute(2, 0, 1)
    drawn = drawn + (matrices.view(3, *read.shape) * read).sum(dim=1).permute(1, 2, 0)
    return torch.where(drawn_at, drawn, 0) + background[:3]


@pytest.mark.parametrize("history", [False, True])
@pytest.mark.parametrize("share", [0.03, 1.0])
@pytest.mark.parametrize(("channels", "scale", "blocks"), [(6, 4, 2), (3, 2, 1), (4, 1, 3)])
def test_cells_are_drawn_as_by_a_dense_network(
    history: bool, share: float, channels: int, scale: int, blocks: int
) -> None:
    matter = torch.rand(12, 14, generator=torch.Generator().manual_seed(2)) < share
    observation = observe(12, 14, channels=channels, scale=scale, matter=matter)
    renderer = shaken(new_renderer(channels, scale, history=history, blocks=blocks))
    assert (len(observation.cells) < 0.9 * 12 * 14) == (share < 1)
    want = dense(renderer.double(), doubled(observation))
    assert (want != 1).any()
    got = renderer([doubled(observation)]).pictures[0]
    torch.testing.assert_close(got, want, rtol=0, atol=ROUNDING)
    quick = renderer.float()([observation])
    torch.testing.assert_close(quick.pictures[0].double(), want, rtol=0, atol=FLOAT32_ERROR)
    with torch.no_grad():  # where products are convolutions, of another order of sums
        frozen = renderer([observation])
    torch.testing.assert_close(frozen.pictures, quick.pictures, rtol=0, atol=FLOAT32_ERROR)
    torch.testing.assert_close(frozen.error, quick.error, rtol=0, atol=FLOAT32_ERROR)


def test_a_picture_that_is_missing_shows_nothing() -> None:
    renderer, warm = shaken(new_renderer()), observe()
    assert warm.history is not None
    unknown = warm.history[0], torch.zeros_like(warm.history[1])
    cold = renderer([replace(warm, history=None)]).pictures
    assert torch.equal(renderer([replace(warm, history=unknown)]).pictures, cold)
    assert (renderer([warm]).pictures - cold).abs().max() > 1e-3


@pytest.mark.parametrize("wrong", [-2, 20])
def test_an_index_that_names_no_point_of_the_surface_is_refused(wrong: int) -> None:
    observation = observe()
    observation.surface.index[3, 2] = wrong
    with pytest.raises(IndexError, match="out of range"):
        new_renderer()([observation])


@pytest.mark.parametrize("history", [False, True])
def test_gradients_reach_every_parameter_and_the_features_of_all_that_is_shown(
    history: bool,
) -> None:
    renderer = shaken(new_renderer(history=history))
    observation = observe(history=history)
    features = observation.frame.values, observation.surface.values
    for tensor in features:
        tensor.requires_grad_()
    drawing = renderer([observation])
    (drawing.pictures.square().sum() + drawing.error.sum()).backward()
    for name, parameter in renderer.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name
    for tensor in features:
        assert tensor.grad is not None
        assert tensor.grad.any(dim=0).all()  # every channel, RGB and others


@pytest.mark.parametrize("scale", [1, 2, 3, 4])
def test_an_untrained_network_draws_the_present_colours_enlarged(scale: int) -> None:
    """Whatever is at the surface. A preceding picture would be blended in half and half."""
    observation = observe(6, 5, scale=scale)
    assert (observation.surface.index >= 0).any()
    picture = new_renderer(scale=scale, history=False)([observation]).pictures[0]
    # With scales of 2^n, weights and values are multiples of 1/4096: nothing is rounded.
    rounded = BLENDING if scale == 3 else 0
    torch.testing.assert_close(picture, enlarged(observation, scale), rtol=0, atol=rounded)


def test_where_nothing_is_the_picture_is_the_background() -> None:
    observation = observe(matter=torch.zeros(5, 7, dtype=torch.bool))
    pictures = shaken(new_renderer())([observation]).pictures
    assert (pictures == 1).all()
    pictures.sum().backward()  # a patch without matter stops no training


@pytest.mark.parametrize(("row", "column"), [(5, 6), (0, 0), (12, 13)])
def test_a_batch_of_two_is_one_after_the_other(row: int, column: int) -> None:
    observations = [
        doubled(observe(14, 16, matter=spot(14, 16, row, column))),
        doubled(observe(14, 16, matter=spot(14, 16, 3, 3), seed=1)),
    ]
    renderer = shaken(new_renderer()).double()
    together = renderer(observations)
    first, second = (renderer([observation]) for observation in observations)
    for got, parts in (
        (together.pictures, (first.pictures, second.pictures)),
        (together.error, (first.error, second.error)),
    ):
        torch.testing.assert_close(got, torch.cat(parts), rtol=0, atol=ROUNDING)
    assert second.error.shape == (len(observations[1].cells),)
    assert second.error.std() > 0


def test_its_products_are_those_that_torch_counts_and_nine_for_each_channel_of_a_block() -> None:
    width, blocks, cells = 16, 2, 5
    network = new_renderer(width=width, blocks=blocks).network
    inputs = torch.zeros(cells, network.enter.in_features), torch.full((cells, 9), -1)
    with FlopCounterMode(display=False) as counter:
        network(*inputs)
    taps = cells * blocks * 9 * width  # sums, which torch does not count
    assert network.products(*inputs) == counter.get_total_flops() // 2 + taps


def test_half_precision_changes_the_network_and_nothing_else() -> None:
    renderer, observation = shaken(new_renderer()), observe()
    with torch.autocast("cpu", torch.bfloat16):
        half = renderer([observation]).pictures
        still = new_renderer(history=False)([observation]).pictures
    assert half.dtype == torch.float32
    assert torch.equal(still[0], enlarged(observation, 4))
    # A correction below 1, of sums of which each term is off by 1/256.
    assert 0 < (half - renderer([observation]).pictures).abs().max() < 0.1


def pretrained() -> LeanRenderer:
    """What the weights that come with the package were trained as, but smaller."""
    return shaken(new_renderer(3, 4), seed=1)


def widened(observation: LeanObservation) -> LeanObservation:
    """Six features, of which the last three are everywhere what they are in the background."""

    def wide(values: Tensor) -> Tensor:
        return functional.pad(values, (0, 3), value=0.5)

    surface = observation.surface  # whose last value, the opacity, stays the last
    values = torch.cat((wide(surface.values[:, :-1]), surface.values[:, -1:]), dim=1)
    return replace(
        observation,
        frame=replace(observation.frame, values=wide(observation.frame.values)),
        background=wide(observation.background),
        surface=replace(surface, values=values),
    )


@pytest.mark.parametrize("channels", [3, 6])
@pytest.mark.parametrize("history", [False, True])
def test_a_renderer_starts_as_the_pretrained_one_draws(channels: int, history: bool) -> None:
    """Of what both know: the same picture, whatever else it may be shown later."""
    start, renderer = pretrained(), new_renderer(channels, history=history)
    renderer._start_from(start.network.state_dict())
    known = doubled(observe(channels=3, history=history))
    want = start.double()([known]).pictures
    got = renderer.double()([widened(known) if channels == 6 else known]).pictures
    torch.testing.assert_close(got, want, rtol=0, atol=ROUNDING)


def test_the_weights_of_what_the_pretrained_one_never_saw_stay() -> None:
    renderer = new_renderer(4)
    before = {name: x.clone() for name, x in renderer.network.state_dict().items()}
    renderer._start_from(pretrained().network.state_dict())
    stayed = {name: x == before[name] for name, x in renderer.network.state_dict().items()}
    columns = renderer.layout.split(stayed["enter.weight"].all(dim=0))
    assert columns["rest"].all()
    assert columns["surface rest"].all()
    assert not any(part.any() for name, part in columns.items() if not name.endswith("rest"))
    cell = [False, False, False, False, True]  # the colour, the opacity, a feature
    assert stayed["read.weight"].all(dim=1).tolist() == 3 * cell
    assert stayed["read.bias"].tolist() == 3 * cell
    for name in ("leave.weight", "leave.bias", "trunk.0.spread"):
        assert not stayed[name].any(), name


def test_pretrained_weights_are_read_from_their_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    halves = {name: x.half() for name, x in pretrained().network.state_dict().items()}
    save_file(halves, tmp_path / "lean.safetensors")
    monkeypatch.setattr(lean_renderer, "PRETRAINED", tmp_path / "lean.safetensors")
    renderer = LeanRenderer(3, 1, 4, width=16, blocks=2, init="pretrained")
    for name, weight in renderer.network.state_dict().items():
        assert torch.equal(weight, halves[name].float()), name


def test_the_weights_of_the_package_have_the_inputs_that_are_read() -> None:
    assert load_file(PRETRAINED)["enter.weight"].shape[1] == PRETRAINED_LAYOUT.width


@pytest.mark.parametrize("other", [{"width": 8}, {"blocks": 1}, {"blocks": 3}, {"scale": 2}])
def test_pretrained_weights_of_another_shape_are_refused(other: dict[str, Any]) -> None:
    with pytest.raises(
        ValueError, match=r"renderer\.init=pretrained: .* use renderer\.init=scratch"
    ):
        new_renderer(3, **other)._start_from(pretrained().network.state_dict())


def test_weights_that_were_pretrained_with_other_inputs_are_refused() -> None:
    """Their columns would be taken for others."""
    without = new_renderer(3, history=False)
    with pytest.raises(ValueError, match=r"renderer\.init=pretrained: .* 68"):
        new_renderer(3)._start_from(without.network.state_dict())
