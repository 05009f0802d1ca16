"""What the methods that start from a trained field have in common: a training survives a kill and
is found again; they learn a ball; wrong settings are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

from bench.types import Log, NullProbe, Scene
from methods.instant_ngp.stage1 import train_field
from methods.training import loop
from tests.methods.small_students import SMALL, budget, extraction, fitted
from tests.methods.trainings import EXACT_TEACHER, PIXEL, goes_on_after_a_kill, shows_the_ball
from tests.methods.usual import lessons

names = pytest.mark.parametrize("name", SMALL)


@pytest.mark.parametrize(
    ("name", "steps", "killed_at"),
    [
        ("diver", 40, 3),
        ("diver", 40, 25),  # after its voxels were pruned
        ("kilonerf", 12, 8),  # of which six from points
        ("nerf", 4, 3),  # points, then rays
        ("nsvf", 4, 3),
        ("plenoctree", 20, 9),
    ],
)
def test_a_killed_training_goes_on_as_if_it_had_not_been(
    name: str, steps: int, killed_at: int, ball_scene: Scene, shared_log: Log, tmp_path: Path
) -> None:
    given = budget(name, steps)
    trained = train_field(SMALL[name]().teacher, ball_scene, given, shared_log)

    def training() -> loop.Training:
        return SMALL[name]().begin(trained, ball_scene, given)

    goes_on_after_a_kill(training, killed_at, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "steps", "least", "off"),
    [
        ("diver", 200, 24, 2 / 32),  # voxels
        ("kilonerf", 40, 20, 4 * PIXEL),
        ("nerf", 60, 16, 1.0),
        ("nsvf", 60, 16, 1.0),
    ],
)
def test_it_learns_a_ball(
    name: str, steps: int, least: float, off: float, ball_scene: Scene, shared_log: Log
) -> None:
    shows_the_ball(fitted(name, ball_scene, shared_log, steps), ball_scene, least, off)


@names
def test_a_training_is_found_again(name: str, ball_scene: Scene, shared_log: Log) -> None:
    first = fitted(name, ball_scene, shared_log)
    again = fitted(name, ball_scene, shared_log)
    other = fitted(name, ball_scene, shared_log, stop=0.5)  # is chosen after a training
    assert first.train_s == again.train_s == other.train_s > 0
    camera = ball_scene.splits["test"].cameras[0]
    pictures = [method.render(camera, NullProbe()).rgb for method in (first, again)]
    assert torch.equal(*pictures)


@names
def test_a_row_names_what_its_own_products_are_computed_in(name: str) -> None:
    """`stored` is another matter: it is what they are computed from."""
    teacher = replace(EXACT_TEACHER, precision="bf16")
    as_teacher = name in ("nerf", "nsvf")
    shown = SMALL[name](teacher=teacher).settings()
    computed = teacher.settings(object)["field_precision"] if as_teacher else "fp32"
    assert (shown["engine"], shown["precision"]) == ("none", "none")
    assert shown["field_precision"] == computed


REFUSED: list[tuple[Callable[..., Any], str, Any]] = [
    *((make, "stop", 1.0) for make in SMALL.values()),
    (SMALL["nerf"], "steps", 0),
    *((SMALL["diver"], "resolution", x) for x in (100, 1024)),
    (SMALL["diver"], "stored", "int8"),
    (SMALL["diver"], "faint", 1.0),
    *((SMALL["kilonerf"], "networks", x) for x in (0, 33)),
    (SMALL["nsvf"], "resolution", 40),
    (SMALL["nsvf"], "step", 0.0),
    (SMALL["plenoctree"], "stored", "fp8"),
    (partial(lessons, "diver"), "corner_rate", 0.0),
    (partial(lessons, "diver"), "prune_at", 2.0),
    (partial(lessons, "diver"), "prune_below", 1.0),
    *((partial(lessons, "nerf"), "share", x) for x in (0.0, 1.5)),
    (partial(lessons, "nerf"), "points", 2.0),
    (partial(lessons, "kilonerf"), "points_each", 0),
    (partial(lessons, "kilonerf"), "view_cost", -1.0),
    (partial(lessons, "plenoctree"), "density_rate", -1.0),
    (partial(lessons, "plenoctree"), "samples", 0),
    *((extraction, "resolution", x) for x in (100, 192, 4096)),
    (extraction, "degree", 4),
    (extraction, "directions", 3),
    (extraction, "rays", 0),
    (extraction, "least_weight", float("nan")),
]


@pytest.mark.parametrize(("make", "setting", "value"), REFUSED)
def test_wrong_settings_are_refused(make: Callable[..., Any], setting: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{setting}: expected"):
        make(**{setting: value})
