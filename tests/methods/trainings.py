"""What is asked of every method that trains: what it learned, and that a kill changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from bench.compositing import composite
from bench.metrics import psnr
from bench.types import Method, NullProbe, Scene
from methods.training import loop


def quality(method: Method, scene: Scene, split: str = "test", view: int = 1) -> float:
    """PSNR of a view of `scene`, in dB; of the ball a white picture has 11.4."""
    some = scene.splits[split]
    truth = composite(some.images[view], scene.background)
    return psnr(method.render(some.cameras[view], NullProbe()).rgb, truth)


def goes_on_after_a_kill(new: Callable[[], loop.Training], killed_at: int, folder: Path) -> None:
    """Assert that a training that is stopped after `killed_at` steps and goes on from its
    checkpoint ends with the same numbers as one that was not; `new` begins one."""
    whole, half = new(), new()
    while whole.step < whole.steps:
        whole.advance()
    while half.step < killed_at:
        half.advance()
    loop.save(half, folder / "half")
    resumed = new()
    loop.resume(resumed, folder / "half")
    while resumed.step < resumed.steps:
        resumed.advance()
    found, expected = resumed.result(), whole.result()
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert torch.equal(found[name], value), name
