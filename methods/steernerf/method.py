"""SteerNeRF (Li et al. 2022), as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import torch

from bench.motion import preceding, viewing_target
from bench.provenance import digest
from bench.study import Axis, Study, Variant, turned
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, NullProbe, Probe, Scene
from methods.engines import Engine, Inputs
from methods.instant_ngp.field import Precision
from methods.instant_ngp.stage1 import Setup, train_field
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.kernels.types import expect
from methods.steernerf.buffer import Buffer
from methods.steernerf.options import JointOptions, Model, Rendering
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.stage2 import Stage2, train_stage2
from methods.steernerf.unet import Renderer2d

HOW = "method.rendering"
SKIPS = {"empty space": f"{HOW}.skip.empty", "hidden samples": f"{HOW}.skip.hidden"}
TABLES = (14, 16, 17, 19)  # sizes of the hash table, log2 T


def not_skipped(skips: Mapping[str, str]) -> list[Variant]:
    """Variants that each switch off one of `skips`."""
    return [Variant(f"{name} not skipped", (f"{word}=false",)) for name, word in skips.items()]


RANGES = turned("range", f"{HOW}.range.epsilon", (0.01, 0.03, 0.1), f"{HOW}.range.mode=paper")
STUDY = Study(
    knobs={
        "skips": not_skipped(SKIPS),
        "step length": turned("step", f"{HOW}.step", (1.5, 2, 3)),
        "stop": turned("stop", f"{HOW}.stop", ("1e-1", "3e-2", "1e-3", "1e-4")),
        "range reduction": RANGES,
    },
    trained={
        "L, trained": turned("L", "method.model.frames", (0, 1, 3)),
        "K, trained": turned("K", "method.model.channels", (3, 9)),
        "log2 T, trained": turned("log2 T", "method.grid.log2_table", (15, 19)),
        "field, trained": turned("field", "method.precision", ("fp32",)),
    },
    exact=(f"{HOW}.range.mode=off", f"{HOW}.step=1", f"{HOW}.skip.hidden=false"),
    skips=SKIPS,
    savings=(Variant("and range reduction", (f"{HOW}.range.mode=paper",)),),
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
"""What studies vary, and the stages of a frame."""


class SteerNerf:
    """SteerNeRF: low-resolution features of a field, preceding frames and a 2D renderer.

    `grid`, `training` and `precision` are those of the field of stage 1, which other methods share.
    Stage 2 trains `renderer`, a factory, and the field for `model`, as `joint` says, in `steps`
    steps (None: `budget.renderer_steps`), of which `Stage2` uses a share `after`. `engine` then
    computes the 2D renderer's network. `rendering` may be replaced between frames.
    """

    study = STUDY
    kind: ClassVar[type[Stage2]] = Stage2

    def __init__(
        self,
        *,
        grid: HashGrid,
        training: TrainingOptions,
        model: Model,
        rendering: Rendering,
        renderer: Callable[..., Renderer2d],
        joint: JointOptions,
        engine: Engine,
        steps: int | None = None,
        after: float = 1.0,
        precision: Precision = "bf16",
        name: str = "steernerf",
        backend: str = "auto",
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        mode, possible = rendering.range.mode, "off without preceding frames (L = 0)"
        expect(model.frames > 0 or mode == "off", "rendering.range.mode", possible, mode)
        self.stage2 = self.kind(model, renderer, joint, after)
        self.setup = Setup.resolved(grid, training, precision, backend, device, seed)
        engine.check(self.setup.device)
        with torch.random.fork_rng(devices=[]):  # refuses before hours of training
            self.stage2.make(self.setup)
        self.rendering, self.engine, self.name = rendering, engine, name
        self.steps, self.train_s = steps, 0.0
        self.memory, self.buffer = model.frames, Buffer(maxlen=model.frames)

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train both stages, or load their results if they were trained before; build the network
        of the 2D renderer with the engine, which computes it from now on."""
        budget = replace(budget, renderer_steps=self.steps or budget.renderer_steps)
        with torch_threads(budget.threads):
            self.trained = train_field(self.setup, scene, budget, log)
            given = self.trained, self.setup, self.stage2, scene, budget, log
            self.pipeline, trained, seconds = train_stage2(*given)
        self.train_s = self.trained.train_s + seconds
        renderer, engine = self.pipeline.renderer, self.engine
        count = engine.samples(renderer.network)
        samples = partial(self.record, self.pipeline, scene, count, log)

        def folder() -> Path:
            key = {"trained": trained, "engine": engine.key(), "recorded": digest(type(self))}
            return log.stage_dir("network", key)

        built = engine.build(renderer.network, samples, folder, log)
        renderer.engine, self.renderer_bytes = built.run, built.size

    def reset(self) -> None:
        """Forget preceding frames."""
        self.buffer.clear()

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """Render the next frame of the sequence."""
        return self.pipeline.render(camera, self.buffer, self.rendering, probe)

    def sizes(self) -> dict[str, int]:
        """Bytes of table, networks, occupancy bits and 2D renderer."""
        return self.trained.sizes() | {"renderer2d": self.renderer_bytes}

    def settings(self) -> dict[str, str]:
        """Those of the field, with the engine and precision of the 2D renderer."""
        precision = self.engine.computed(self.setup.device)
        return self.setup.settings() | {"engine": self.engine.name, "precision": precision}

    def record(self, pipeline: Pipeline, scene: Scene, count: int, log: Log) -> list[Inputs]:
        """The inputs of the network in `count` training views, evenly spread, on which an engine is
        calibrated. They are rendered as in training, whatever `rendering` is, each after L + 1
        frames of a random motion: even the oldest frame in the buffer had a preceding one."""
        generator = torch.Generator().manual_seed(self.setup.seed)
        cameras, target = scene.splits["train"].cameras, viewing_target(scene)
        network, frames, joint = pipeline.renderer.network, pipeline.model.frames, self.stage2.joint
        rendering, degrees = joint.rendering(pipeline.model), joint.motion.degrees
        recorded: list[Inputs] = []
        with log.progress("frames to build the network on", count) as progress:
            for place in range(count):
                camera, buffer = cameras[place * len(cameras) // count], Buffer(maxlen=frames)
                for before in preceding(camera, target, frames + 1, degrees, generator):
                    pipeline.remember(before, buffer, rendering)
                with network.register_forward_pre_hook(lambda _, xs: recorded.append(xs)):
                    pipeline.render(camera, buffer, rendering, NullProbe())
                progress.advance()
        return recorded
