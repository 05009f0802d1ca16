"""Settings that make no sense are refused by name, before anything is trained."""

from collections.abc import Callable
from functools import partial
from math import nan
from typing import Any

import pytest

from methods.steernerf.options import RangeReduction
from tests.common import refusal
from tests.methods.models import small_joint, small_model, small_motion, small_rendering
from tests.methods.small_students import SMALL, extraction
from tests.methods.trainings import GRID, QUICK
from tests.methods.usual import field_options, lessons, new_gaussians, new_ngp

NGP = partial(new_ngp, grid=GRID, training=QUICK)
GAUSSIANS = partial(new_gaussians, grid=GRID, training=QUICK)
RANGE = partial(RangeReduction, mode="paper", depth="sum")

REFUSED: list[tuple[Callable[..., Any], str, Any]] = [
    *((field_options, name, 0.0) for name in ("rate", "march_step", "share")),
    *((field_options, name, -1.0) for name in ("opacity_entropy", "thin")),
    *(
        (field_options, name, 1)
        for name in ("max_rays", "rays", "grid_samples", "by_error", "stop")
    ),
    *((field_options, "share", 1.5), (field_options, "final_rate", 2.0)),
    *((NGP, "device", name) for name in ("", "gpu", "cpu:0", "meta")),
    *((GAUSSIANS, "count", 0), (GAUSSIANS, "degree", 4)),
    *((make, "stop", 1.0) for make in (NGP, GAUSSIANS, small_model, small_rendering)),
    *((make, "stop", 1.0) for make in SMALL.values()),
    *((make, "step", 0.0) for make in (small_model, small_rendering, SMALL["nsvf"])),
    *((small_model, "channels", x) for x in (2, 257)),
    *((small_model, "frames", x) for x in (-1, 65)),
    *((small_model, "scale", x) for x in (0, 65)),
    *((RANGE, "range.epsilon", x) for x in (0.0, -1.0, nan)),
    (small_joint, "joint.half_waves", 2),
    (small_motion, "joint.motion.degrees", (2.0,)),
    (SMALL["nerf"], "steps", 0),
    *((SMALL["diver"], "resolution", x) for x in (100, 1024)),
    (SMALL["diver"], "faint", 1.0),
    *((SMALL["kilonerf"], "networks", x) for x in (0, 33)),
    (SMALL["nsvf"], "resolution", 40),
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
    (extraction, "least_weight", nan),
]


@pytest.mark.parametrize(("make", "setting", "value"), REFUSED)
def test_wrong_settings_are_refused(make, setting, value):
    with refusal(f"^{setting}: expected", ValueError):
        make(**{setting.rpartition(".")[2]: value})
