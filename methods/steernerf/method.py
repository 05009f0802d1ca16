"""SteerNeRF (Li et al. 2022), as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from bench.sources import digest
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.engines import Engine, Inputs
from methods.instant_ngp.field import Precision
from methods.instant_ngp.stage1 import Setup, train_field
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.encode import HashGrid
from methods.steernerf.buffer import RenderingBuffer
from methods.steernerf.calibration import Calibration
from methods.steernerf.options import Model, Rendering
from methods.steernerf.renderer import Renderer2d
from methods.steernerf.study import STUDY
from methods.steernerf.training.options import JointOptions
from methods.steernerf.training.stage2 import Stage2, TrainedPipeline, train_stage2


class SteerNerf:
    """SteerNeRF: low-resolution features of a field, preceding frames and a 2D renderer.

    Args:
        grid: shape of the hash table.
        training: how stage 1 trains the field alone, at full resolution; all methods with the same
            options share the result.
        model: the settings that stage 2 trains for.
        rendering: the settings chosen after training.
        renderer: factory of the 2D renderer, called with K, L and s.
        joint: how stage 2 trains on patches.
        steps: of stage 2; None: `budget.renderer_steps`.
        after: share of these steps whose weights are used; see `training.stage2.Stage2`.
        engine: computes the network of the 2D renderer once it is trained.
        precision: of the field, "bf16" (packed table, bfloat16 networks) or "fp32".
        name: as shown in result rows.

    Attributes:
        rendering: may be replaced between frames.
    """

    study = STUDY

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
        self.stage2 = Stage2(model, renderer, joint, after)
        _check(self.stage2, rendering)
        self.setup = Setup.resolved(grid, training, precision, backend, device, seed)
        engine.check(self.setup.device)
        self.rendering, self.engine, self.name = rendering, engine, name
        self.steps = steps
        self.memory, self.buffer = model.frames, RenderingBuffer(model.frames)
        self.train_s = 0.0

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
        self.buffer.reset()

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """Render the next frame of the sequence."""
        return self.pipeline.render(camera, self.buffer, self.rendering, probe)

    def sizes(self) -> dict[str, int]:
        """Bytes of table, networks, occupancy bits and 2D renderer."""
        return self.trained.sizes() | {"renderer2d": self.renderer_bytes}

    def settings(self) -> dict[str, str]:
        """See `bench.types.Method.settings`; engine and precision are those of the 2D renderer."""
        return self.setup.settings() | {
            "engine": self.engine.name,
            "precision": self.engine.computed(self.setup.device),
        }

    def _build_network(self, second: TrainedPipeline, scene: Scene, log: Log) -> None:
        """Build the network of the 2D renderer with the engine, which computes it from now on.

        The engine is calibrated on frames rendered as in training, so that the result does not
        depend on `rendering`.
        """
        renderer, engine, joint = second.pipeline.renderer, self.engine, self.stage2.joint
        rendering = Rendering.in_training(self.stage2.model, joint.refined, joint.refined_step)
        calibration = Calibration(
            second.pipeline, rendering, scene, joint.motion.degrees, self.setup.seed
        )
        count, code = engine.samples(renderer.network), digest(Calibration)
        key = {"trained": second.key, "calibration": code}

        def samples() -> list[Inputs]:
            return calibration.inputs(count, log.stage_dir("inputs", {**key, "frames": count}), log)

        def folder() -> Path:
            return log.stage_dir("network", {**key, "engine": engine.key()})

        built = engine.build(renderer.network, samples, folder, log)
        renderer.engine, self.renderer_bytes = built.run, built.size


def _check(stage2: Stage2, rendering: Rendering) -> None:
    """Raise ValueError, before anything is trained, if settings contradict each other."""
    model = stage2.model
    if not model.frames and rendering.range.mode != "off":
        raise ValueError(
            "rendering.range.mode: expected off without preceding frames (L = 0), got "
            f"{rendering.range.mode}"
        )
    kinds = model.reprojection.depth, rendering.range.depth
    if rendering.range.mode != "off" and kinds == ("expected", "sum"):
        raise ValueError(
            "rendering.range.depth: expected the depth that is kept, model.reprojection.depth="
            "expected; got sum"
        )
    with torch.random.fork_rng(devices=()):  # queried for its abilities; another one is trained
        renderer = stage2.make_renderer(model.channels, model.frames, model.scale)
    for name in ("history", "surface"):
        if getattr(model, name) and not renderer.reads_details:
            raise ValueError(
                f"model.{name}: {type(renderer).__name__} does not read it: expected false, got "
                "true"
            )
    for name, share in (
        ("rendering.refined", rendering.refined),
        ("joint.refined", stage2.joint.refined),
    ):
        if share and not renderer.estimates_error:
            raise ValueError(
                f"{name}: {type(renderer).__name__} does not estimate its error, expected 0, got "
                f"{share}"
            )
