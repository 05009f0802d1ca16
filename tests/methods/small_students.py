"""The methods that start from a trained field, as small as they can learn something."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from bench.types import Budget, Log, Scene
from methods.instant_ngp.stage1 import Setup
from methods.plenoctree.octree import Extraction
from methods.students.method import Student
from tests.methods.trainings import EXACT_TEACHER, TAUGHT, TEACHER
from tests.methods.usual import lessons, usual


def small(
    name: str, teacher: Setup, lesson: Mapping[str, Any], **options: Any
) -> Callable[..., Student]:
    training = lessons(name, **lesson)
    return partial(usual, f"method/{name}", teacher=teacher, training=training, **options)


extraction: Callable[..., Extraction] = partial(
    usual,
    "method/plenoctree",
    "extraction",
    **{"resolution": 128, "degree": 1, "rays": 20_000, "points": 2, "directions": 8},
)
SMALL = {
    "diver": small("diver", TEACHER, {"prune_rays": 1 << 13}, resolution=32),
    "kilonerf": small("kilonerf", TEACHER, {"points_each": 64, "rate": 1e-2}, networks=4),
    "nerf": small("nerf", EXACT_TEACHER, {}),
    "nsvf": small("nsvf", EXACT_TEACHER, {"rate": 2e-3}, resolution=32),
    "plenoctree": small("plenoctree", TEACHER, {"samples": 8192}, extraction=extraction()),
}


def budget(name: str, steps: int) -> Budget:
    exact = name in ("nerf", "nsvf")
    return replace(TAUGHT, steps=80 if exact else TAUGHT.steps, renderer_steps=steps)


def fitted(name: str, scene: Scene, log: Log, steps: int = 2, **options: Any) -> Student:
    method = SMALL[name](**options)
    method.fit(scene, budget(name, steps), log)
    return method
