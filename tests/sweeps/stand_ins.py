"""A method and a scene that take no time, for tests of what happens around a measurement."""

from __future__ import annotations

import time
from pathlib import Path

import torch

from bench.types import Budget, Camera, Frame, Log, Probe, Scene, Split, SteerbenchError


class Grey:
    """Renders grey pictures; `fit` can be told to fail or to hang until it is killed."""

    name = "grey"

    def __init__(
        self, seed: int, device: str, backend: str, level: float = 0.5, fit: str = "works"
    ) -> None:
        self.level = level
        self._fit = fit

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train nothing; "hangs" says so on standard error, for whoever waits to kill it."""
        folder = log.stage_dir("grey", {"level": self.level})
        if self._fit == "fails":
            raise SteerbenchError("fit failed as it was told to")
        if self._fit == "hangs":
            log.info("hanging")
            try:
                time.sleep(600)
            finally:
                (folder / "cleaned-up").touch()

    def reset(self) -> None:
        """There is nothing to forget."""

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """A grey picture."""
        with probe.stage("paint"):
            size = (camera.height, camera.width)
            rgb = torch.full((*size, 3), self.level)
            return Frame(rgb, torch.full(size, torch.inf), torch.zeros(size))

    def sizes(self) -> dict[str, int]:
        """One number."""
        return {"level": 4}

    def settings(self) -> dict[str, str]:
        """Fixed."""
        return {"device": "cpu", "backend": "none", "engine": "torch", "precision": "fp32"}


def plain(*, frames: int = 2, path: str = "", log: Log) -> Scene:
    """A scene of white 40 x 32 pictures."""
    if path and not Path(path).exists():
        raise SteerbenchError(f"{path}: no such folder")
    camera = Camera(torch.eye(4)[:3], 40.0, 40.0, 20.0, 16.0, 40, 32)
    picture = torch.full((32, 40, 3), 255, dtype=torch.uint8)
    names = [f"view_{i}" for i in range(frames)]
    split = Split([camera] * frames, [picture] * frames, names)
    white = torch.ones(3)
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("plain", {"train": split, "test": split}, white, bounds, 1.0, f"digest-{frames}")
