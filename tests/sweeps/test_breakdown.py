"""`steerbench breakdown`: the part that a stage is counted in, the field that all lines share."""

from __future__ import annotations

import pytest

from bench.errors import SteerbenchError
from sweeps.breakdown import DENSE, NGP, UNET, _compared, of_stage_1, part_of
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
        ("finish", "finish"),
        ("other", "other"),
        ("a stage of some other method", "other"),
    ],
)
def test_a_stage_is_counted_with_the_innermost_that_has_a_column(stage: str, part: str) -> None:
    assert part_of(stage) == part


def test_of_the_settings_those_of_the_field_are_shared() -> None:
    shared = ["method.grid.log2_table=14", "method.precision=fp32", "scene=totem", "seed=3"]
    own = ["method=steernerf_k3", "method.pipeline.refined=0", "method.joint.patch=16"]
    assert of_stage_1([*own, *shared]) == shared
    assert of_stage_1(["~method.joint.patch", "+note=here", "method.stop=1e-3"]) == [
        "+note=here",
        "method.stop=1e-3",
    ]


def test_what_is_compared_is_better_where_an_arrow_says_so() -> None:
    rows = {
        "fp32": {"frame_ms": 20.0, "network": 5.0, "psnr": 30.0},
        "int8": {"frame_ms": 10.0, "network": 2.0, "psnr": 29.5},
        "int8" + DENSE: {"frame_ms": 40.0, "network": 8.0, "psnr": 29.75},
        "int8" + UNET: {"frame_ms": 99.0, "network": 60.0, "psnr": None},
        NGP: {"frame_ms": 70.0, "network": 0.0, "psnr": 31.0},
    }
    ratios = ("7.0", "6.0", "30.0")  # 70 / 10, 60 / 10, 60 / 2
    assert _compared(rows, "int8", "fp32") == ("int8", *ratios, "0.500", "0.250", "25.0 %")


@pytest.mark.parametrize("method", ["ngp", "steernerf_paper"])
def test_a_method_that_cannot_skip_cells_is_refused_at_once(method: str) -> None:
    with pytest.raises(SteerbenchError, match="expected a method with renderer=s2d"):
        dispatch(["breakdown", f"method={method}"])
