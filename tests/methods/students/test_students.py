"""What the methods that start from a trained field have in common."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from bench.types import Unavailable
from methods.diver.method import Diver
from methods.diver.training import DiverLessons
from methods.gaussians.method import GaussianSplatting
from methods.gaussians.training import Fitting
from methods.kilonerf.method import KiloNerf
from methods.kilonerf.training import KiloLessons
from methods.nerf.method import Nerf
from methods.nsvf.method import Nsvf
from methods.plenoctree.method import PlenOctree
from methods.plenoctree.start import Extraction
from methods.plenoctree.training import OctreeLessons
from methods.students.networks import NetworkLessons
from sweeps.overrides import composed
from tests.methods.trainings import EXACT_TEACHER, GRID, QUICK

OWN: dict[Any, dict[str, Any]] = {
    Diver: {"training": DiverLessons()},
    KiloNerf: {"training": KiloLessons()},
    Nerf: {"training": NetworkLessons()},
    Nsvf: {"training": NetworkLessons()},
    PlenOctree: {"training": OctreeLessons(), "extraction": Extraction()},
}
names = pytest.mark.parametrize("kind", OWN, ids=lambda kind: kind.kind)


@names
def test_by_triton_there_is_none(kind: Any) -> None:
    with pytest.raises(Unavailable, match=f"{kind.kind} has no Triton kernels: use backend=auto"):
        kind(teacher=replace(EXACT_TEACHER, backend="gpu"), **OWN[kind])


def test_by_triton_there_are_no_gaussians() -> None:
    with pytest.raises(Unavailable, match="gaussians has no Triton kernels"):
        GaussianSplatting(grid=GRID, training=QUICK, fitting=Fitting(), count=9, backend="gpu")


@names
@pytest.mark.parametrize("wrong", [{"stop": 1.0}, {"steps": 0}], ids=str)
def test_wrong_settings_are_refused(kind: Any, wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="expected"):
        kind(teacher=EXACT_TEACHER, **OWN[kind] | wrong)


@names
def test_a_step_of_the_full_budget_has_the_rays_of_the_release(kind: Any) -> None:
    assert composed([f"method={kind.kind}", "budget=full"]).method.training.max_rays == 16_384
