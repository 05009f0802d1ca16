"""Prints how often the host waits for a GPU, line by line: in a frame, and in a step of training.

    python -m tests.device_waits

The GPU is pretended, the scene small, and the fields have hardly learned anything, so that a frame
has more rounds of rays than usual: compare the counts with earlier ones, not with a real GPU's.
"""

from __future__ import annotations

import linecache
import tempfile
from collections import Counter
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch

from bench.console import ConsoleLog
from bench.types import NullProbe, Scene, Split
from bench.waits import Line, device_waits
from methods.instant_ngp.training import FieldTraining
from methods.steernerf.training.joint import JointTraining
from tests.methods.conftest import ball, look_at_the_middle
from tests.methods.test_on_a_gpu import BUDGET, METHODS
from tests.pretended_gpu import pretended_gpu

ROOT = Path(__file__).parent.parent


def small_scene() -> Scene:
    cameras = [look_at_the_middle(i / 40, 0.3) for i in range(4)]
    split = Split(cameras, [ball(camera) for camera in cameras], [f"r_{i}" for i in range(4)])
    bounds = torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]])
    return Scene("ball", {"train": split, "test": split}, torch.ones(3), bounds, 1.0, "ball")


def counted(what: str, call, waits: dict[str, list[Counter[Line]]]):
    """`call`, which adds what it waits for to those of `what`."""

    def calling(*args):
        with device_waits() as found:
            result = call(*args)
        waits.setdefault(what, []).append(found)
        return result

    return calling


def show(what: str, times: list[Counter[Line]]) -> None:
    total = sum(times, Counter())
    print(f"\n{what}: {total.total() / len(times):.1f} waits, mean of {len(times)}")
    for line, count in total.most_common():
        place = f"{Path(line.path).relative_to(ROOT)}:{line.number}"
        print(f"{count / len(times):8.1f}  {place:48} {linecache.getline(*line).strip()}")


def main() -> None:
    scene = small_scene()
    budget = replace(BUDGET, steps=18, renderer_steps=4)
    for name in ("ngp", "steernerf", "steernerf_lean"):
        waits: dict[str, list[Counter[Line]]] = {}
        with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
            stack.enter_context(pretended_gpu())
            for kind in (FieldTraining, JointTraining):
                step = counted(f"a step of {kind.__name__}", kind.advance, waits)
                stack.enter_context(patch.object(kind, "advance", step))
            method = METHODS[name](device="cuda", backend="reference")
            method.fit(scene, budget, ConsoleLog(Path(folder), quiet=True))
            render = counted(f"a frame of {name}", method.render, waits)
            for camera in scene.splits["test"].cameras:
                render(camera, NullProbe())
            waits[f"a frame of {name}"] = waits[f"a frame of {name}"][2:]  # with preceding ones
        for what, times in waits.items():
            if name == "ngp" or "Field" not in what:
                show(what, times)


if __name__ == "__main__":
    main()
