"""`steerbench breakdown`: the part that a stage is counted in, the field that all lines share."""

from __future__ import annotations

import pytest

from bench.errors import SteerbenchError
from sweeps.breakdown import of_the_field, part_of
from sweeps.cli import dispatch


@pytest.mark.parametrize(
    ("stage", "part"),
    [
        ("field", "field"),
        ("field/march", "field"),
        ("march", "field"),  # of Instant-NGP, which has no other rays
        ("feature_reprojection", "reprojection"),
        ("feature_reprojection/surface", "surface"),
        ("feature_reprojection/surface/anything", "surface"),
        ("renderer2d", "renderer2d"),
        ("renderer2d/network", "network"),
        ("refinement/field", "refinement"),
        ("finish", "rest"),
        ("other", "rest"),
        ("a stage of some other method", "rest"),
    ],
)
def test_a_stage_is_counted_with_the_innermost_that_has_a_column(stage: str, part: str) -> None:
    assert part_of(stage) == part


def test_of_the_settings_those_of_the_field_are_shared() -> None:
    shared = ["method.grid.log2_table=14", "method.precision=fp32", "scene=totem", "seed=3"]
    own = ["method=steernerf_k3", "method.pipeline.refined=0", "method.joint.patch=16"]
    assert of_the_field([*own, *shared]) == shared


@pytest.mark.parametrize("method", ["ngp", "steernerf_paper"])
def test_a_method_that_cannot_skip_cells_is_refused_at_once(method: str) -> None:
    with pytest.raises(SteerbenchError, match="expected a method with renderer=s2d"):
        dispatch(["breakdown", f"method={method}"])
