"""SteerNeRF (Li et al. 2022), as a `bench.types.Method`."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from bench.provenance import digest
from bench.study import Study, Variant, turned
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.engines import Engine
from methods.instant_ngp.stage1 import OnField, train_field
from methods.kernels.compilation import compile_kernels
from methods.kernels.settings import Steps
from methods.kernels.types import expect
from methods.steernerf.buffer import Buffer
from methods.steernerf.options import JointOptions, ModelOptions, Rendering
from methods.steernerf.stage2 import Stage2, train_stage2
from methods.steernerf.unet import UNet
from methods.steernerf.views import recorded_inputs

HOW = "method.rendering"
SKIPS = {
    "empty space": f"{HOW}.skip.empty",
    "hidden and faint samples": f"{HOW}.skip.hidden",
    "background": f"{HOW}.skip.background",
}

RANGES = turned("range", f"{HOW}.range.epsilon", (0.01, 0.03, 0.1), f"{HOW}.range.mode=paper")


@dataclass(kw_only=True, eq=False)
class SteerNerf(OnField):
    """SteerNeRF: low-resolution features of a field, preceding frames and a 2D renderer.

    `grid`, `training` and `precision` are those of the field of stage 1, which other methods share.
    Stage 2 trains the U-Net that `renderer` makes, and the field, for `model`, as `joint` says, in
    `steps` steps (None: `budget.renderer_steps`). `engine` then computes the network of the U-Net.
    `rendering` may be replaced between frames.
    """

    model: ModelOptions
    rendering: Rendering
    renderer: partial[UNet]
    joint: JointOptions
    engine: Engine
    steps: Steps
    name: str

    study = Study(
        knobs={
            "skips": [
                Variant(f"{name} not skipped", (f"{word}=false",)) for name, word in SKIPS.items()
            ],
            "step length": turned("step", f"{HOW}.step", (1.5, 3, 4)),
            "stop": turned("stop", f"{HOW}.stop", ("1e-1", "3e-2", "1e-3", "1e-4")),
            "range reduction": RANGES,
        },
        trained={"field, trained": turned("field", "method.precision", ("fp32",))},
        exact=(
            f"{HOW}.range.mode=off",
            f"{HOW}.step=1",
            f"{HOW}.skip.hidden=false",
            f"{HOW}.skip.background=false",
        ),
        skips=SKIPS,
        savings=(Variant("all, and range reduction", (f"{HOW}.range.mode=paper",)),),
        parts={
            "field": "field",
            "depth_reprojection": "reprojection",
            "feature_reprojection": "reprojection",
            "renderer2d": "renderer2d",
            "renderer2d/network": "network",
            "finish": "finish",
        },
        chosen=("rendering", "engine"),
    )

    def __post_init__(self) -> None:
        frames, mode = self.model.frames, self.rendering.range.mode
        possible = "off without preceding frames (L = 0)"
        expect(frames > 0 or mode == "off", "rendering.range.mode", possible, mode)
        self.stage2 = Stage2(self.model, self.renderer, self.joint)
        super().__post_init__()
        self.engine.check(self.setup.device)
        with torch.random.fork_rng(devices=[]):  # refuses before hours of training
            self.stage2.make(self.setup)
        self.memory, self.buffer = frames, Buffer(maxlen=frames)

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train both stages, or load their results if they were trained before; build the network
        of the 2D renderer with the engine, which computes it from now on."""
        budget = replace(budget, renderer_steps=self.steps or budget.renderer_steps)
        self.compile_s = compile_kernels(type(self), self.setup.backend, log)
        with torch_threads(budget.threads):
            self.trained = train_field(self.setup, scene, budget, log)
            self.pipeline, trained, seconds, peak = train_stage2(
                self.trained,
                self.setup,
                self.stage2,
                scene,
                budget,
                log,
            )
        self.train_s = self.trained.train_s + seconds
        self.train_peak_bytes = max(self.trained.train_peak_bytes, peak)
        renderer = self.pipeline.renderer
        views = self.engine.samples, self.setup.seed

        def samples() -> list[Tensor]:
            return recorded_inputs(self.pipeline, scene, self.stage2.joint, *views, log)

        def folder() -> Path:
            key = {
                "trained": trained,
                "engine": self.engine.key(),
                "recorded": digest(type(self)),
            }
            return log.stage_dir("network", key)

        renderer.engine = self.built = self.engine.build(renderer.network, samples, folder, log)

    def reset(self) -> None:
        self.buffer.clear()

    def render(self, camera: Camera, probe: Probe) -> Frame:
        return self.pipeline.render(camera, self.buffer, self.rendering, probe)

    def sizes(self) -> dict[str, int]:
        return self.trained.sizes() | {"renderer2d": self.built.size}

    def settings(self) -> dict[str, str]:
        """Those of the field, with the engine and precision of the 2D renderer."""
        computed = self.engine.computed(self.setup.device)
        return super().settings() | {"engine": self.engine.name, "precision": computed}
