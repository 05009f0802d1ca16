"""The lean SteerNeRF, our variant, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.study import Variant, turned
from bench.types import Budget, Log, Scene
from methods.steernerf.method import SteerNerf
from methods.steernerf.study import STUDY, not_skipped, ranges
from methods.steernerf_lean.pretraining import pretrain_renderer

SHARES = (0, 0.06, 0.25, 0.5, 1)
SKIPS = {**STUDY.skips, "background cells": "method.rendering.skip.background"}


def _both(one: Variant, other: Variant) -> Variant:
    return Variant(f"{one.name}, {other.name}", (*one.settings, *other.settings))


def _refined(shares: Sequence[float]) -> list[Variant]:
    return turned("refined", "method.rendering.refined", shares)


def _refined_steps(lengths: Sequence[float]) -> list[Variant]:
    return turned("refined step", "method.rendering.refined_step", lengths)


def _together() -> list[Variant]:
    """Variants that turn two knobs at a time."""
    low = [*turned("step", "method.rendering.step", (1,)), *ranges("window", (0.03,))]
    return [
        *(_both(share, other) for share in _refined(SHARES) for other in low),
        *(_both(share, step) for share in _refined(SHARES[1:]) for step in _refined_steps((1,))),
    ]


class SteerNerfLean(SteerNerf):
    """SteerNeRF with a lean 2D renderer, preceding pictures, and refinement."""

    study = replace(
        STUDY,
        knobs={
            **STUDY.knobs,
            "skips": not_skipped(SKIPS),
            "step length": turned("step", "method.rendering.step", (1, 1.5, 3, 4)),
            "refined step length": _refined_steps((1, 1.5, 3)),
            "refined share": _refined((0, 0.03, 0.06, 0.25, 0.5, 1)),
            "two knobs": _together(),
        },
        trained={
            **STUDY.trained,
            "L, trained": turned("L", "method.model.frames", (0, 2, 3)),
            "s, trained": turned(
                "s", "method.model.scale", (2, 4, 8), "method.renderer.init=scratch"
            ),
            "step, trained": turned("trained step", "method.model.step", (1, 3)),
        },
        exact=(
            *STUDY.exact,
            "method.rendering.refined=1",
            "method.rendering.skip.background=false",
        ),
        skips=SKIPS,
        skips_with=("method.rendering.refined=0",),  # refinement takes a share of the cells drawn
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
        """Train a 2D renderer on many scenes, as a start for others; see
        `beyond.pretraining.pretrain_renderer`."""
        pretrain_renderer(self.setup, self.stage2, scenes, budget, output, log)
