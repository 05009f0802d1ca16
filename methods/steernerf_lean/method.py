"""The lean SteerNeRF, our variant, as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from bench.study import Variant, turned
from bench.types import Budget, Log, Scene
from methods.steernerf.method import STUDY, SteerNerf
from methods.steernerf_lean.training import LeanStage2

HOW = "method.rendering"
REFINED = turned("refined", f"{HOW}.refined", (0, 0.03, 0.06, 0.25, 0.5, 1))
REFINED_STEPS = turned("refined step", f"{HOW}.refined_step", (1, 1.5, 3))
STEPS = turned("step", f"{HOW}.step", (1, 1.5, 3, 4))
SHARES = [REFINED[0], *REFINED[2:]]
SCRATCH = "method.renderer.init=scratch"
REFINED_AS_IT_IS = "method.joint.refined_step=2"  # it would follow the step
PARTS = {"feature_reprojection/surface": "surface", "refinement": "refinement"}
PAPERS = (
    *("method=steernerf", "method.renderer.width=64"),
    *("method.steps=null", "budget.renderer_steps=8"),
)
"""The release's network; its cost does not depend on how well it is trained."""


def _both(one: Variant, other: Variant) -> Variant:
    return Variant(f"{one.name}, {other.name}", (*one.settings, *other.settings))


class SteerNerfLean(SteerNerf):
    """SteerNeRF with a lean 2D renderer, the preceding picture, and refinement."""

    kind = LeanStage2
    stage2: LeanStage2
    study = replace(
        STUDY,
        knobs={
            **STUDY.knobs,
            "skips": STUDY.knobs["skips"][:-1],  # without the background, of which it is a share
            "step length": STEPS,
            "refined step length": REFINED_STEPS,
            "refined share": REFINED,
            "two knobs": [
                *(_both(share, STEPS[0]) for share in SHARES),
                *(_both(share, REFINED_STEPS[0]) for share in SHARES[1:]),
            ],
        },
        trained={
            **STUDY.trained,
            "L, trained": turned("L", "method.model.frames", (0,)),
            "s, trained": [
                Variant(
                    f"s {s}", (f"method.model.scale={s}", f"method.joint.patch={128 // s}", SCRATCH)
                )
                for s in (2, 4, 8)  # patches of 128 pixels
            ],
            "step, trained": turned("trained step", "method.model.step", (1, 3), REFINED_AS_IT_IS),
        },
        exact=(*STUDY.exact, f"{HOW}.overlap=0", f"{HOW}.refined=1"),
        skips_with=(f"{HOW}.refined=0",),  # refinement takes a share of the cells drawn
        axes={name: axis for name, axis in STUDY.axes.items() if name != "L"},
        parts={**STUDY.parts, **PARTS},
        beside={**STUDY.beside, "the paper's": PAPERS},
    )

    def pretrain_renderer(
        self, scenes: Sequence[Scene], budget: Budget, output: Path, log: Log
    ) -> None:
        """Train a 2D renderer on many scenes, as a start for others."""
        self.stage2.pretrain(self.setup, scenes, budget, output, log)
