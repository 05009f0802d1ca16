"""Prints how often the host waits for a GPU, line by line: in a frame, in a step of training, and,
apart from the step, in a frame that precedes what the step learns from.

    python -m tests.device_waits

The GPU is pretended, the scene small, and the fields have hardly learned anything, so that a frame
takes more samples than usual: compare the counts with earlier ones, not with a real GPU's.
"""

from __future__ import annotations

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
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.training.joint import JointTraining
from methods.steernerf_lean.pipeline import LeanPipeline
from tests.methods.conftest import ball, look_at_the_middle
from tests.methods.test_on_a_gpu import BUDGET, METHODS
from tests.pretended_gpu import pretended_gpu

PARTS = {
    "a step of stage 1": (FieldTraining, "advance"),
    "a step of stage 2": (JointTraining, "advance"),
    "a frame that precedes what stage 2 learns from": (Pipeline, "remember"),
    "the same of the lean method": (LeanPipeline, "remember"),
}


def counted(what: str, call, waits: dict[str, list[Counter[Line]]]):
    """`call`, which adds what it waits for to those of `what`."""

    def calling(*args):
        with device_waits() as found:
            result = call(*args)
        waits.setdefault(what, []).append(found)
        return result

    return calling


def main() -> None:
    cameras = [look_at_the_middle(i / 40, 0.3) for i in range(4)]
    split = Split(cameras, [ball(camera) for camera in cameras], [f"r_{i}" for i in range(4)])
    bounds = torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]])
    scene = Scene("ball", {"train": split, "test": split}, torch.ones(3), bounds, 1.0, "ball")
    budget = replace(BUDGET, steps=18, renderer_steps=4)
    for name in ("ngp", "steernerf", "steernerf_lean"):
        waits: dict[str, list[Counter[Line]]] = {}
        with ExitStack() as stack, tempfile.TemporaryDirectory() as folder:
            stack.enter_context(pretended_gpu())
            for what, (kind, part) in PARTS.items():
                call = counted(what, getattr(kind, part), waits)
                stack.enter_context(patch.object(kind, part, call))
            method = METHODS[name](device="cuda", backend="reference")
            method.fit(scene, budget, ConsoleLog(Path(folder), quiet=True))
            render = counted(f"a frame of {name}", method.render, waits)
            for camera in scene.splits["test"].cameras:
                render(camera, NullProbe())
            waits[f"a frame of {name}"] = waits[f"a frame of {name}"][2:]  # with preceding ones
        for what, times in waits.items():
            if name == "ngp" or "stage 1" not in what:
                total = sum(times, Counter())
                print(f"\n{what}: {total.total() / len(times):.1f} waits, mean of {len(times)}")
                for line, count in total.most_common():
                    print(f"{count / len(times):8.1f}  {line.place:48} {line.source}")


if __name__ == "__main__":
    main()
