"""The lean 2D renderer starts from the weights of another: what it takes over, and what stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional

from methods.steernerf_lean import lean_renderer
from methods.steernerf_lean.lean_renderer import PRETRAINED, PRETRAINED_LAYOUT, LeanRenderer
from methods.steernerf_lean.observation import LeanObservation
from tests.methods.observations import ROUNDING, doubled, new_renderer, observe, shaken


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
