"""Methods and a scene that take no time, for tests of what happens around a measurement."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from bench.study import Axis, Study, Variant
from bench.types import Budget, Camera, Frame, Log, NullProbe, Probe, Scene, Split, SteerbenchError

LEVELS = (0.4, 0.6, 1.0)


class Grey:
    """Renders pictures of one grey `level`; its training fails when that is no colour.

    While a file `hang` lies in the working directory, the training waits to be killed.
    """

    name = "grey"
    train_s = 0.0
    memory = 0

    @property
    def reads(self) -> list[Path]:
        """As a checkpoint from elsewhere, if it is there."""
        return list(filter(Path.exists, [Path("shade")]))

    def __init__(self, seed: int, device: str, backend: str, level: float = 0.5) -> None:
        self.level = level

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        folder = log.stage_dir("grey", {"level": self.level})
        if not 0 <= self.level <= 1:
            raise SteerbenchError(f"method.level: expected 0 to 1, got {self.level}")
        if Path("hang").exists():
            try:
                log.info("hanging")
                time.sleep(600)
            finally:
                (folder / "cleaned-up").touch()

    def reset(self) -> None:
        pass

    def render(self, camera: Camera, probe: Probe) -> Frame:
        with probe.stage("paint"):
            size = (camera.height, camera.width)
            rgb = torch.full((*size, 3), self.level)
            return Frame(rgb, torch.full(size, torch.inf), torch.zeros(size))

    def sizes(self) -> dict[str, int]:
        return {"level": 4}

    def settings(self) -> dict[str, str]:
        by = {"device": "cpu", "backend": "none", "field_precision": "fp32"}
        return by | {"engine": "none", "precision": "none"}


class Gated(Grey):
    """A grey whose training waits at the FIFO `gate` in the outputs, while there is one.

    Before, it writes its parent process into the FIFO `waiting`.
    """

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        outputs = log.stage_dir("grey", {"level": self.level}).parents[1]
        if (outputs / "gate").exists():
            (outputs / "waiting").write_text(f"{os.getppid()}\n")
            (outputs / "gate").read_text()
        super().fit(scene, budget, log)


class Shades(Grey):
    """A grey that can be varied: it paints again and again, and leaves out what is `skipped`.

    Its engine computes nothing, but is built like any other.
    """

    name = "shades"
    study = Study(
        knobs={
            "level": [Variant(f"level {level}", (f"method.level={level}",)) for level in LEVELS]
        },
        trained={"seed, trained": [Variant("seed 7", ("method.seed=7",))]},
        exact=("method.skip.left=false",),
        skips={"left half": "method.skip.left", "right half": "method.skip.right"},
        savings=[Variant("all, and half as bright", ("method.level=0.25",))],
        axes={"N": Axis("N = 2^{}", "method.log2_layers", (0, 3))},
        parts={"paint": "painting", "paint/network": "network"},
    )

    def __init__(
        self,
        seed: int,
        engine: Any,
        skip: Mapping[str, bool],
        level: float = 0.5,
        log2_layers: int = 0,
    ) -> None:
        super().__init__(seed, "cpu", "none", level)
        self.skip, self.layers, self.engine = skip, 2**log2_layers, engine

    def render(self, camera: Camera, probe: Probe) -> Frame:
        painted = 2 - sum(self.skip.values())
        probe.count("halves", painted * self.layers, 2 * self.layers)
        with probe.stage("paint"), probe.stage("network"):
            for _ in range(painted * self.layers):
                torch.full((camera.height, camera.width), self.level)
        with probe.stage("varnish"):
            return super().render(camera, NullProbe())


def white(*, frames: int = 2, path: str = "", log: Log) -> Scene:
    """White pictures of 40 x 32 pixels."""
    camera = Camera(torch.eye(4)[:3], 40.0, 40.0, 20.0, 16.0, 40, 32)
    picture = torch.full((32, 40, 3), 255, dtype=torch.uint8)
    split = Split([camera] * frames, [picture] * frames, [f"view_{i}" for i in range(frames)])
    bounds = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    splits = {"train": split, "test": split}
    return Scene("white", splits, torch.ones(3), bounds, 1.0, digest=f"white pictures: {frames}")
