"""`steerbench pretrain`: its scenes and settings, and what it refuses before any training."""

from __future__ import annotations

from pathlib import Path

import pytest
from omegaconf import DictConfig


class Recorder:
    """In place of all that is built: notes the settings, trains nothing."""

    def __init__(self) -> None:
        self.config: dict[str, dict] = {}
        self.variants: list[int] = []
        self.fitted: list[tuple] = []

    def build(self, config: DictConfig, group: str, **extra: object) -> object:
        self.config[group] = dict(config[group])
        if group != "scene":
            return self if group == "method" else group
        self.variants.append(config.scene.variant)
        return f"medley {config.scene.variant}"

    def pretrain_renderer(self, scenes: list[str], budget: str, output: Path, log: object) -> None:
        self.fitted.append((scenes, budget, output))


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    """What `steerbench pretrain` has built and trained."""
    recorder = Recorder()
    monkeypatch.setattr("sweeps.commands.pretrain.build", recorder.build)
    return recorder


def test_one_renderer_is_trained_on_as_many_scenes_as_asked_for(steerbench, recorder):
    outcome = steerbench("pretrain", "--scenes", "3", "--output", "w.safetensors", "seed=5")
    assert outcome.status == 0
    scenes = ["medley 0", "medley 1", "medley 2"]
    assert recorder.fitted == [(scenes, "budget", Path("w.safetensors"))]
    assert recorder.config["budget"]["name"] == "pretrain"
    method = recorder.config["method"]
    assert method["name"] == "steernerf_lean"
    assert method["seed"] == 5
    assert method["model"]["channels"] == 3
    assert method["renderer"]["init"] == "scratch"


def test_as_many_threads_are_used_as_asked_for(steerbench, recorder, monkeypatch):
    asked = []
    monkeypatch.setattr("torch.set_num_threads", asked.append)
    assert steerbench("pretrain", "--scenes", "1", "--output", "w", "threads=1").status == 0
    assert asked == [1]


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--scenes", "0", "--output", "w"], "--scenes: expected 1 or more, got 0"),
        (["--scenes", "2"], "the following arguments are required: --output"),
        (["--output", "w", "method.joint.rat=1"], "Did you mean method.joint.rate?"),
        (["--output", "w", "seed=-1"], "seed: expected 0 or more"),
    ],
)
def test_a_wrong_word_is_answered_with_what_is_expected(steerbench, recorder, argv, message):
    outcome = steerbench("pretrain", *argv)
    assert outcome.status == 2
    assert message in outcome.err
    assert recorder.fitted == []
