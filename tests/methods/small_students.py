"""The methods that start from a trained field, as small as they can learn something."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from bench.types import Budget, Log, Scene
from methods.diver.method import Diver
from methods.diver.training import DiverLessons
from methods.kilonerf.method import KiloLessons, KiloNerf
from methods.nerf.method import Nerf
from methods.nsvf.method import Nsvf
from methods.plenoctree.method import OctreeLessons, PlenOctree
from methods.plenoctree.octree import Extraction
from methods.students.fields import FieldLessons
from methods.students.method import Student
from tests.methods.trainings import EXACT_TEACHER, TAUGHT, TEACHER

LEAVES = {"resolution": 128, "degree": 1, "rays": 20_000, "points": 2, "directions": 8}
SMALL: dict[str, Callable[..., Student]] = {
    "diver": partial(
        Diver, teacher=TEACHER, training=DiverLessons(prune_rays=1 << 13), resolution=32
    ),
    "kilonerf": partial(
        KiloNerf, teacher=TEACHER, training=KiloLessons(points_each=64, rate=1e-2), networks=4
    ),
    "nerf": partial(Nerf, teacher=EXACT_TEACHER, training=FieldLessons()),
    "nsvf": partial(Nsvf, teacher=EXACT_TEACHER, training=FieldLessons(rate=2e-3), resolution=32),
    "plenoctree": partial(
        PlenOctree,
        teacher=TEACHER,
        training=OctreeLessons(samples=8192),
        extraction=Extraction(**LEAVES),
    ),
}


def budget(name: str, steps: int) -> Budget:
    exact = name in ("nerf", "nsvf")
    return replace(TAUGHT, steps=80 if exact else TAUGHT.steps, renderer_steps=steps)


def fitted(name: str, scene: Scene, log: Log, steps: int = 2, **options: Any) -> Student:
    method = SMALL[name](**options)
    method.fit(scene, budget(name, steps), log)
    return method
