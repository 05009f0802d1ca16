"""`steerbench pretrain`: its scenes and settings, and what it refuses before any training."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from omegaconf import DictConfig

from bench.types import Log


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The settings of what `steerbench pretrain` has built, and what it has trained: nothing is."""
    seen: dict[str, Any] = {"trained": []}

    def train(scenes: list[str], budget: object, output: Path, log: Log) -> None:
        seen["trained"].append((scenes, output, torch.get_num_threads()))

    method = SimpleNamespace(pretrain_renderer=train)

    def build(config: DictConfig, group: str, **extra: object) -> object:
        seen[group] = config[group]
        if group == "budget":
            return SimpleNamespace(threads=config.budget.threads)
        return method if group == "method" else f"scene {config.scene.variant}"

    monkeypatch.setattr("sweeps.commands.pretrain.build", build)
    return seen


def test_one_renderer_is_trained_on_as_many_scenes_as_asked_for(steerbench, built):
    words = ("--output", "w.safetensors", "seed=5", "budget.threads=1")
    assert steerbench("pretrain", "--scenes", "3", *words).status == 0
    scenes = ["scene 0", "scene 1", "scene 2"]
    assert built["trained"] == [(scenes, Path("w.safetensors"), 1)]
    assert built["scene"].name == "medley"
    assert built["budget"].name == "pretrain"
    method = built["method"]
    assert (method.name, method.seed) == ("steernerf_lean", 5)
    assert (method.model.channels, method.renderer.init) == (3, "scratch")


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["--scenes", "0", "--output", "w"], "--scenes: expected 1 or more, got 0"),
        (["--scenes", "2"], "the following arguments are required: --output"),
        (["--output", "w", "method.joint.rat=1"], "Did you mean method.joint.rate?"),
        (["--output", "w", "seed=-1"], "seed: expected 0 or more"),
        (["--output", "w", "scene=totem"], "scene: expected one that differs in each variant"),
    ],
)
def test_a_wrong_word_is_answered_with_what_is_expected(steerbench, built, argv, message):
    assert message in steerbench("pretrain", *argv).refused()
    assert built == {"trained": []}
