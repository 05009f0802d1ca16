"""SteerNeRF (Li et al. 2022), as a `bench.types.Method`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import cache, partial
from pathlib import Path

import torch
from torch import Tensor

from bench.motion import viewing_target
from bench.provenance import ROOT, digest, foreign_digest
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.engines import Engine
from methods.instant_ngp.field import Precision
from methods.instant_ngp.stage1 import Pretrained, Setup, pretrain
from methods.instant_ngp.training import TrainingOptions
from methods.kernels import serves_many_threads, sources
from methods.kernels.encode import HashGrid
from methods.steernerf.beyond.lean_renderer import GENERIC
from methods.steernerf.beyond.pretraining import train_generic
from methods.steernerf.buffer import RenderingBuffer
from methods.steernerf.lookahead import Lookahead
from methods.steernerf.options import PipelineOptions
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.renderer import Renderer2d, check_refined
from methods.steernerf.training.calibration import kept_inputs, recorded_inputs
from methods.steernerf.training.distillation import distilled_views
from methods.steernerf.training.joint import JointOptions, JointTraining, RendererTraining
from methods.steernerf.training.patches import PatchSource
from methods.steernerf.training.sequences import SequencePool, TrueView, true_views
from methods.training import loop

SOURCES = (
    "buffer",
    "cell_network",
    "cells",
    "distil",
    "joint",
    "patches",
    "pipeline",
    "pipeline_options",
    "range_reduction",
    "refresh",
    "renderer2d",
    "rounds",
    "sequences",
    "space_to_depth",
    "steernerf",
    "surface",
    "unet_release",
    "view",
)
"""Modules beside this one that decide what stage 2 results in, with those of stage 1."""

CALIBRATED_BY = ("calibration.py", "engines/__init__.py")
"""Files below this folder that decide on which frames an engine's network is built."""

NOT_TRAINED_FOR = ("overlap", "range", "refresh", "refined", "refined_steps", "skip")
"""Options of a pipeline that stage 2 does not depend on; see `PipelineOptions.taught`."""


class SteerNerf:
    """Low-resolution features of a field, preceding frames and a 2D renderer.

    Args:
        grid: shape of the hash table.
        training: stage 1, the field alone at full resolution; shared with every other method that
            trains it in the same way.
        pipeline: what a frame is made of.
        renderer: makes the 2D renderer, called with K, L and s.
        joint: stage 2, on patches, of `budget.renderer_steps` steps.
        engine: computes the network of the 2D renderer once it is trained.
        precision: of the field, "bf16" (packed table, bfloat16 networks) or "fp32".
        name: as it stands in result rows.
    """

    def __init__(
        self,
        *,
        grid: HashGrid,
        training: TrainingOptions,
        pipeline: PipelineOptions,
        renderer: Callable[..., Renderer2d],
        joint: JointOptions,
        engine: Engine,
        precision: Precision = "bf16",
        name: str = "steernerf",
        backend: str = "auto",
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        with torch.device("meta"):  # shapes alone: refused, if at all, before anything is trained
            made = renderer(pipeline.channels, pipeline.frames, pipeline.scale)
        pipeline.check(grid, made)
        check_refined("joint.refined", joint.refined, made)
        self.setup = Setup.resolved(grid, training, precision, backend, device, seed)
        self.options, self.make_renderer, self.joint, self.name = pipeline, renderer, joint, name
        engine.check(self.setup.device)
        self.engine, self.memory = engine, pipeline.frames
        self.buffer, self.lookahead = RenderingBuffer(pipeline.frames), Lookahead()
        self.train_s = 0.0

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train both stages, or load what the same trainings left behind."""
        seed, options = self.setup.seed, self.options
        trained = pretrain(self.setup, scene, budget, log)
        key = self.setup.key(scene, budget)
        target = viewing_target(scene)
        distilled: list[TrueView] = []
        distilled_s = 0.0
        if views := self.joint.distilled(budget.renderer_steps, options.frames):
            of_views = {**key, "views": views, "stage2": stage2_digest()}
            folder = log.stage_dir("distilled", of_views)
            distilled, distilled_s = distilled_views(
                trained, scene, target, views, seed, folder, log
            )
        trained.field.widen(options.channels)
        self.pipeline, training = self._stage2(trained, scene, distilled, target, budget)
        key |= self._key(budget)
        folder = log.stage_dir("steernerf", key)
        loop.train(training, folder / "steernerf.safetensors", f"training {self.name}", log)
        trained.field.requires_grad_(False).grad_buffer = None
        self.trained = trained
        self.train_s = trained.train_s + distilled_s + training.seconds
        self.pipeline.renderer.requires_grad_(False)
        self._hand_over(scene, target, key, log)

    def fit_generic(self, scenes: Sequence[Scene], budget: Budget, output: Path, log: Log) -> None:
        """Train a 2D renderer on many scenes, for others to start from; see `methods.steernerf.beyond.pretraining`."""
        fields = [self.setup.key(scene, budget) for scene in scenes]
        code = digest([ROOT / "methods" / "generic.py"])
        key = {"fields": fields, "generic": code, **self._key(budget)}
        folder = log.stage_dir("generic", key)
        train_generic(
            self.setup,
            self.options,
            self.make_renderer,
            self.joint,
            scenes,
            budget,
            folder,
            output,
            log,
        )

    def reset(self) -> None:
        """Forget preceding frames."""
        self.buffer.reset()
        self.lookahead.forget()

    def foresee(self, camera: Camera) -> bool:
        """See `bench.lookahead.Foreseeing`: of use with two threads of a CPU or more. On a GPU the
        next frame would need a stream of its own, which it has not."""
        device = self.setup.device
        shared = torch.get_num_threads() > 1 and serves_many_threads(self.setup.backend, device)
        if useful := device.type == "cpu" and shared:
            self.lookahead.foresee(camera)
        return useful

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """The next frame of the sequence."""
        return self.lookahead.render(self.pipeline, camera, self.buffer, probe)

    def sizes(self) -> dict[str, int]:
        """Bytes of table, networks, occupancy bits and 2D renderer."""
        return self.trained.sizes() | {"renderer2d": self.renderer_bytes}

    def settings(self) -> dict[str, str]:
        """See `bench.types.Method.settings`; engine and precision are those of the 2D renderer."""
        return self.setup.settings() | {
            "engine": self.engine.name,
            "precision": self.engine.precision,
        }

    def _hand_over(self, scene: Scene, target: Tensor, key: dict[str, object], log: Log) -> None:
        """Have the engine compute the network of the 2D renderer from now on."""
        renderer, engine = self.pipeline.renderer, self.engine
        # What is not trained for is not calibrated for, either: one network serves all of it.
        usual = self.options.taught(self.joint.refined)
        trained, background = self.trained, self.pipeline.background[:3]
        pipeline = Pipeline(trained.field, trained.occupancy, background, renderer, usual)
        count = engine.samples(renderer.network)
        options = (count, self.joint.motion, self.setup.seed, log)
        record = partial(recorded_inputs, pipeline, scene, target, *options)
        code = digest([ROOT / "methods" / path for path in CALIBRATED_BY])
        shown = {"trained": key, "frames": count, "calibration": code}
        kept = partial(log.stage_dir, "inputs", shown)
        seen = partial(kept_inputs, kept, record, self.setup.device, log)
        parts = {"trained": key, "engine": engine.key(), "calibration": code}
        built = engine.build(renderer.network, seen, partial(log.stage_dir, "network", parts), log)
        renderer.engine, self.renderer_bytes = built.run, built.size

    def _stage2(
        self,
        trained: Pretrained,
        scene: Scene,
        distilled: list[TrueView],
        target: Tensor,
        budget: Budget,
    ) -> tuple[Pipeline, RendererTraining]:
        device, shape, options = self.setup.device, self.options, self.joint
        torch.manual_seed(self.setup.seed)  # of the renderer's weights
        renderer = self.make_renderer(shape.channels, shape.frames, shape.scale)
        renderer = renderer.to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        background = scene.background.to(device)
        pipeline = Pipeline(trained.field, trained.occupancy, background, renderer, shape)
        everywhere = shape.taught(options.refined)
        taught = Pipeline(trained.field, trained.occupancy, background, renderer, everywhere)
        generator = torch.Generator().manual_seed(self.setup.seed)
        pool = SequencePool(
            taught,
            true_views(scene),
            distilled,
            options.distilled_share,
            target,
            options.motion,
            generator,
        )
        learning = options.field == "joint"
        patches = PatchSource(taught, pool, options.patch, learning, options.through, generator)
        rest = (renderer, patches, options, budget.renderer_steps, generator)
        training = JointTraining(taught, *rest) if learning else RendererTraining(*rest)
        pipeline.renderer = taught.renderer = training.mean
        return pipeline, training

    def _key(self, budget: Budget) -> dict[str, object]:
        """What the second stage depends on, beside the first."""
        make = self.make_renderer
        kind, settings = make, {}
        if isinstance(make, partial):
            kind, settings = make.func, make.keywords
        trained_for = {
            name: value
            for name, value in asdict(self.options).items()
            if name not in NOT_TRAINED_FOR
        }
        return {
            "renderer_steps": budget.renderer_steps,
            "pipeline": trained_for,
            "renderer": {
                "kind": f"{kind.__module__}.{kind.__qualname__}",
                "code": foreign_digest(kind),
                **settings,
            },
            "joint": asdict(self.joint),
            "stage2": stage2_digest(),
        }


@cache
def stage2_digest() -> str:
    """SHA-256 of the sources and weights that decide what stage 2 results in, beside those of
    stage 1."""
    modules = [ROOT / "methods" / f"{name}.py" for name in SOURCES]
    kernels = sources("depthwise", "lift", "splat", "warp")
    truth = [ROOT / "bench" / "motion.py", ROOT / "bench" / "protocol.py"]
    return digest([*modules, *kernels, *truth, GENERIC])
