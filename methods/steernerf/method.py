"""SteerNeRF (Li et al. 2022), as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import torch

from bench.motion import preceding, viewing_target
from bench.provenance import digest
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, NullProbe, Probe, Scene
from methods.engines import Engine, Inputs
from methods.instant_ngp.field import Precision
from methods.instant_ngp.stage1 import Setup, train_field
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.steernerf.buffer import Buffer
from methods.steernerf.options import Model, Rendering
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.renderer import Renderer2d
from methods.steernerf.study import STUDY
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.stage2 import Stage2, TrainedPipeline, train_stage2


class SteerNerf:
    """SteerNeRF: low-resolution features of a field, preceding frames and a 2D renderer.

    Args:
        grid: shape of the hash table.
        training: how stage 1 trains the field alone; methods with the same options share it.
        model: the settings that stage 2 trains for.
        rendering: the settings chosen after training; may be replaced between frames.
        renderer: factory of the 2D renderer.
        joint: how stage 2 trains on patches.
        steps: of stage 2; None: `budget.renderer_steps`.
        after: share of these steps whose weights are used; see `training.stage2.Stage2`.
        engine: computes the network of the 2D renderer once it is trained.
        precision: of the field, "bf16" (packed table, bfloat16 networks) or "fp32".
        name: as shown in result rows.
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
        self.stage2 = self.kind(model, renderer, joint, after)
        with torch.random.fork_rng(devices=[]):
            self.stage2.make()  # what a 2D renderer refuses, it refuses before anything is trained
        if rendering.range.mode != "off" and not model.frames:
            raise ValueError(
                "rendering.range.mode: expected off without preceding frames (L = 0), got "
                f"{rendering.range.mode}"
            )
        self.setup = Setup.resolved(grid, training, precision, backend, device, seed)
        engine.check(self.setup.device)
        self.rendering, self.engine, self.name = rendering, engine, name
        self.steps, self.train_s = steps, 0.0
        self.memory, self.buffer = model.frames, Buffer(maxlen=model.frames)

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train both stages, or load their results if they were trained before."""
        budget = replace(budget, renderer_steps=self.steps or budget.renderer_steps)
        with torch_threads(budget.threads):
            self.trained = train_field(self.setup, scene, budget, log)
            second = train_stage2(self.trained, self.setup, self.stage2, scene, budget, log)
        self.pipeline = second.pipeline
        self.train_s = self.trained.train_s + second.train_s
        self._build_network(second, scene, log)

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
        return self.setup.settings() | {
            "engine": self.engine.name,
            "precision": self.engine.computed(self.setup.device),
        }

    def _build_network(self, second: TrainedPipeline, scene: Scene, log: Log) -> None:
        """Build the network of the 2D renderer with the engine, which computes it from now on."""
        renderer, engine = second.pipeline.renderer, self.engine
        count = engine.samples(renderer.network)

        def samples() -> list[Inputs]:
            return self.record(second.pipeline, scene, count, log)

        def folder() -> Path:
            key = {"trained": second.key, "engine": engine.key(), "recorded": digest(type(self))}
            return log.stage_dir("network", key)

        built = engine.build(renderer.network, samples, folder, log)
        renderer.engine, self.renderer_bytes = built.run, built.size

    def record(self, pipeline: Pipeline, scene: Scene, count: int, log: Log) -> list[Inputs]:
        """The inputs of the network in `count` training views, evenly spread, on which an engine is
        calibrated. They are rendered as in training, so that the result does not depend on
        `rendering`, each after L + 1 frames of a random smooth motion: even the oldest frame in the
        buffer had a preceding one."""
        generator = torch.Generator().manual_seed(self.setup.seed)
        cameras, target = scene.splits["train"].cameras, viewing_target(scene)
        rendering, degrees = self.stage2.rendering, self.stage2.joint.motion.degrees
        network, frames = pipeline.renderer.network, pipeline.model.frames
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
