"""The lean SteerNeRF, our variant, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.study import Variant, turned
from bench.types import Budget, Log, Scene
from methods.steernerf.method import SteerNerf
from methods.steernerf.study import SKIPS, STUDY, not_skipped
from methods.steernerf_lean.pretraining import pretrain_renderer
from methods.steernerf_lean.training import LeanStage2

SHARES = (0, 0.06, 0.25, 0.5, 1)
ALL_SKIPS = {**SKIPS, "background cells": "method.rendering.skip.background"}
PARTS = {
    **STUDY.parts,
    "feature_reprojection/surface": "surface",
    "refinement": "refinement",
}


def _both(one: Variant, other: Variant) -> Variant:
    return Variant(f"{one.name}, {other.name}", (*one.settings, *other.settings))


def _refined(shares: Sequence[float]) -> list[Variant]:
    return turned("refined", "method.rendering.refined", shares)


def _refined_steps(lengths: Sequence[float]) -> list[Variant]:
    return turned("refined step", "method.rendering.refined_step", lengths)


def _together() -> list[Variant]:
    """Variants that turn two knobs at a time."""
    (low,) = turned("step", "method.rendering.step", (1,))
    (refined,) = _refined_steps((1,))
    return [
        *(_both(share, low) for share in _refined(SHARES)),
        *(_both(share, refined) for share in _refined(SHARES[1:])),
    ]


class SteerNerfLean(SteerNerf):
    """SteerNeRF with a lean 2D renderer, the preceding picture, and refinement."""

    kind = LeanStage2
    stage2: LeanStage2
    study = replace(
        STUDY,
        knobs={
            **STUDY.knobs,
            "skips": not_skipped(ALL_SKIPS),
            "step length": turned("step", "method.rendering.step", (1, 1.5, 3, 4)),
            "refined step length": _refined_steps((1, 1.5, 3)),
            "refined share": _refined((0, 0.03, 0.06, 0.25, 0.5, 1)),
            "two knobs": _together(),
        },
        trained={
            **STUDY.trained,
            "L, trained": turned("L", "method.model.frames", (0,)),
            "s, trained": turned(
                "s", "method.model.scale", (2, 4, 8), "method.renderer.init=scratch"
            ),
            "step, trained": turned("trained step", "method.model.step", (1, 3)),
        },
        exact=(
            *STUDY.exact,
            "method.rendering.overlap=0",
            "method.rendering.refined=1",
            "method.rendering.skip.background=false",
        ),
        skips=ALL_SKIPS,
        skips_with=("method.rendering.refined=0",),  # refinement takes a share of the cells drawn
        axes={name: axis for name, axis in STUDY.axes.items() if name != "L"},
        parts=PARTS,
        beside={
            **STUDY.beside,
            # The release's network; its cost does not depend on how well it is trained.
            "the paper's": (
                "method=steernerf",
                "method.renderer.width=64",
                "budget.renderer_steps=8",
            ),
        },
    )

    def pretrain_renderer(
        self, scenes: Sequence[Scene], budget: Budget, output: Path, log: Log
    ) -> None:
        """Train a 2D renderer on many scenes, as a start for others."""
        assert isinstance(self.stage2, LeanStage2)
        pretrain_renderer(self.setup, self.stage2, scenes, budget, output, log)
