"""The lean 2D renderer starts from the weights of another: what it takes over, and what stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional

from methods.steernerf.renderer import Observation
from methods.steernerf_lean import lean_renderer
from methods.steernerf_lean.lean_renderer import LeanRenderer
from tests.methods.observations import ROUNDING, doubled, new_renderer, observe, shaken


def pretrained() -> LeanRenderer:
    """What the weights that come with the package were trained as, but smaller."""
    return shaken(new_renderer(3, 1, 4), seed=1)


def widened(observation: Observation) -> Observation:
    """Six features, of which the last three are everywhere what they are in the background."""

    def wide(values: Tensor) -> Tensor:
        return functional.pad(values, (0, 3), value=0.5)

    surface = observation.surface
    if surface is not None:  # whose last value, the opacity, stays the last
        colours, opacity = surface.values[:, :-1], surface.values[:, -1:]
        surface = replace(surface, values=torch.cat((wide(colours), opacity), dim=1))
    return replace(
        observation,
        frame=replace(observation.frame, values=wide(observation.frame.values)),
        background=wide(observation.background),
        preceding=[replace(p, values=wide(p.values)) for p in observation.preceding],
        surface=surface,
    )


@pytest.mark.parametrize("channels", [3, 6])
@pytest.mark.parametrize(
    "parts",
    [
        {"frames": 1},
        {"frames": 0},
        {"frames": 2},
        {"frames": 1, "history": False},
        {"frames": 1, "surface": False},
        {"frames": 0, "surface": False},
    ],
    ids=str,
)
def test_a_renderer_starts_as_the_pretrained_one_draws(channels: int, parts: dict) -> None:
    """Of what both know: the same picture, whatever else it may be shown later."""
    start = pretrained()
    renderer = new_renderer(channels, scale=4, **parts)
    renderer._start_from(start.network.state_dict())
    known = doubled(
        observe(
            channels=3,
            frames=min(parts["frames"], 1),
            history=renderer.layout.history,
            surface=renderer.layout.surface,
        )
    )
    want = start.double()([known]).pictures
    got = renderer.double()([widened(known) if channels == 6 else known]).pictures
    torch.testing.assert_close(got, want, rtol=0, atol=ROUNDING)


def test_the_weights_of_what_the_pretrained_one_never_saw_stay() -> None:
    renderer = new_renderer(4, 2)
    before = {name: x.clone() for name, x in renderer.network.state_dict().items()}
    renderer._start_from(pretrained().network.state_dict())
    stayed = {name: x == before[name] for name, x in renderer.network.state_dict().items()}
    cell = [False, False, False, False, True]  # the colour, whether it is known, a feature
    preceding = 16 * cell + 16 * [True] * 5
    assert (
        stayed["enter.weight"].all(dim=0).tolist() == cell + preceding + 16 * cell[:4] + 16 * cell
    )
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
    renderer = LeanRenderer(3, 1, 4, width=16, blocks=2)
    for name, weight in renderer.network.state_dict().items():
        assert torch.equal(weight, halves[name].float()), name


@pytest.mark.parametrize("other", [{"width": 8}, {"blocks": 1}, {"blocks": 3}, {"scale": 2}])
def test_pretrained_weights_of_another_shape_are_refused(other: dict[str, int]) -> None:
    renderer = new_renderer(3, **other)
    with pytest.raises(
        ValueError, match=r"renderer\.init=pretrained: .* use renderer\.init=scratch"
    ):
        renderer._start_from(pretrained().network.state_dict())


def test_weights_that_were_pretrained_with_other_inputs_are_refused() -> None:
    """Their columns would be taken for others."""
    more = new_renderer(3, 2, 4)
    with pytest.raises(ValueError, match="260 inputs instead of 196"):
        new_renderer(3, 1, 4)._start_from(more.network.state_dict())
