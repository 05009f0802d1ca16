"""What studies vary in SteerNeRF, and the stages of its frames; see `bench.study`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from bench.study import Axis, Study, Variant, turned


def ranges(mode: str, epsilons: Iterable[float]) -> list[Variant]:
    """Variants with range reduction in `mode`, one for each epsilon."""
    return turned(
        f"range {mode}",
        "method.rendering.range.epsilon",
        epsilons,
        f"method.rendering.range.mode={mode}",
    )


PARTS = {
    "field": "field",
    "depth_reprojection": "reprojection",
    "feature_reprojection": "reprojection",
    "feature_reprojection/surface": "surface",
    "renderer2d": "renderer2d",
    "renderer2d/network": "network",
    "refinement": "refinement",
    "finish": "finish",
}

SKIPS = {
    "empty space": "method.rendering.skip.empty",
    "hidden samples": "method.rendering.skip.hidden",
}


def not_skipped(skips: Mapping[str, str]) -> list[Variant]:
    """Variants that each switch off one of `skips`."""
    return [
        Variant(f"{name} not skipped", (f"{setting}=false",)) for name, setting in skips.items()
    ]


STUDY = Study(
    knobs={
        "skips": not_skipped(SKIPS),
        "step length": turned("step", "method.rendering.step", (1.5, 2, 3)),
        "stop": turned("stop", "method.rendering.stop", ("1e-1", "3e-2", "1e-3", "1e-4")),
        "range reduction": [
            *ranges("window", (0.01, 0.03, 0.1)),
            *ranges("paper", (0.01, 0.03, 0.1)),
        ],
    },
    trained={
        "L, trained": turned("L", "method.model.frames", (0, 1, 3)),
        "K, trained": turned("K", "method.model.channels", (3, 9)),
        "log2 T, trained": turned("log2 T", "method.grid.log2_table", (15, 19)),
        "field, trained": turned("field", "method.precision", ("fp32",)),
    },
    exact=(
        "method.rendering.overlap=0",
        "method.rendering.range.mode=off",
        "method.rendering.step=1",
        "method.rendering.skip.hidden=false",
    ),
    skips=SKIPS,
    savings=(Variant("and a window of depths", ("method.rendering.range.mode=window",)),),
    axes={
        "L": Axis("L = {}", "method.model.frames", (0, 1, 2, 3)),
        "K": Axis("K = {}", "method.model.channels", (3, 6, 9)),
        "T": Axis(
            "T = 2^{}",
            "method.grid.log2_table",
            (14, 16, 17, 19),
            tuple(2.0**log2 for log2 in (14, 16, 17, 19)),
        ),
    },
    parts=PARTS,
    network_stage="renderer2d/network",
    network_size="renderer2d",
    beside={"Instant-NGP": ("method=ngp",)},
)
