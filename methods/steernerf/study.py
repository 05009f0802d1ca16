"""What studies vary in SteerNeRF, and the stages of its frames; see `bench.study`."""

from __future__ import annotations

from collections.abc import Mapping

from bench.study import Axis, Study, Variant, turned

SKIPS = {
    "empty space": "method.rendering.skip.empty",
    "hidden samples": "method.rendering.skip.hidden",
}


def not_skipped(skips: Mapping[str, str]) -> list[Variant]:
    """Variants that each switch off one of `skips`."""
    return [Variant(f"{name} not skipped", (f"{word}=false",)) for name, word in skips.items()]


TABLES = (14, 16, 17, 19)
"""Sizes of the hash table, log2 T."""

STUDY = Study(
    knobs={
        "skips": not_skipped(SKIPS),
        "step length": turned("step", "method.rendering.step", (1.5, 2, 3)),
        "stop": turned("stop", "method.rendering.stop", ("1e-1", "3e-2", "1e-3", "1e-4")),
        "range reduction": turned(
            "range",
            "method.rendering.range.epsilon",
            (0.01, 0.03, 0.1),
            "method.rendering.range.mode=paper",
        ),
    },
    trained={
        "K, trained": turned("K", "method.model.channels", (3, 9)),
        "log2 T, trained": turned("log2 T", "method.grid.log2_table", (15, 19)),
        "field, trained": turned("field", "method.precision", ("fp32",)),
    },
    exact=(
        "method.rendering.range.mode=off",
        "method.rendering.step=1",
        "method.rendering.skip.hidden=false",
    ),
    skips=SKIPS,
    savings=(Variant("and range reduction", ("method.rendering.range.mode=paper",)),),
    axes={
        "L": Axis("L = {}", "method.model.frames", (0, 1, 2, 3)),
        "K": Axis("K = {}", "method.model.channels", (3, 6, 9)),
        "T": Axis("T = 2^{}", "method.grid.log2_table", TABLES, tuple(2.0**n for n in TABLES)),
    },
    parts={
        "field": "field",
        "depth_reprojection": "reprojection",
        "feature_reprojection": "reprojection",
        "renderer2d": "renderer2d",
        "renderer2d/network": "network",
        "finish": "finish",
    },
    network_stage="renderer2d/network",
    network_size="renderer2d",
    beside={"Instant-NGP": ("method=ngp",)},
    chosen=("rendering", "after", "engine"),
)
