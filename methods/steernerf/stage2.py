"""Stage 2: the 2D renderer and the field, trained together on patches (Section 3.4)."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property, partial

import torch
from torch.nn import functional

from bench.errors import SteerbenchError
from bench.memory import MemoryMeter
from bench.provenance import digest, libraries
from bench.types import Budget, Log, Scene
from methods.instant_ngp.stage1 import Setup, TrainedField
from methods.instant_ngp.training import FieldOptimiser, restore_field
from methods.kernels import multiplies_bf16
from methods.rendering.batch import opacity_entropy
from methods.rendering.occupancy import EVERY
from methods.steernerf.distillation import distilled_views
from methods.steernerf.options import JointOptions, ModelOptions
from methods.steernerf.patches import Patches
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.unet import UNet
from methods.training import checkpoint, loop
from methods.training.checkpoint import Optimisers, Tensors
from methods.training.muon import Muon

MUON = 5
"""Muon's learning rate, in those of Adam: the root mean square of its updates is then Adam's
rate."""


@dataclass(frozen=True)
class Stage2:
    """What is trained in stage 2, and how."""

    model: ModelOptions  # the settings it is trained for
    renderer: partial[UNet]  # makes the 2D renderer for K, L and s
    joint: JointOptions  # how it is trained

    def key(self, budget: Budget) -> Mapping[str, object]:
        """Everything that the training depends on, besides the field of stage 1."""
        return {
            "renderer_steps": budget.renderer_steps,
            "model": asdict(self.model),
            "renderer": self.renderer.keywords,
            "joint": asdict(self.joint),
            "stage2": digest(Stage2, self.renderer.func),
            "stage2_libraries": libraries(Stage2),
        }

    def make(self, setup: Setup) -> UNet:
        """Make the untrained 2D renderer of the seed and the device of `setup`."""
        torch.manual_seed(setup.seed)
        model = self.model
        return self.renderer(model.channels, model.frames, model.scale).to(setup.device)


def train_stage2(
    trained: TrainedField, setup: Setup, stage2: Stage2, scene: Scene, budget: Budget, log: Log
) -> tuple[Pipeline, Mapping[str, object], float, float]:
    """Train `stage2` on the field that `setup` made for `scene`, or load the result of the same
    training. The field is widened to K features and changed in place. Returns the pipeline, the
    key of its weights, and the seconds and the peak memory of stage 2 up to them."""
    model = stage2.model
    joint = stage2.joint
    steps = budget.renderer_steps
    key = {**setup.key(scene, budget), **stage2.key(budget)}
    finished = log.stage_dir("steernerf", key) / "steernerf.safetensors"
    count = 0 if finished.exists() else joint.distilled(steps)
    # These show the field of stage 1, which is changed from here on.
    meter = MemoryMeter(str(setup.device))
    with meter:
        distilled, distilled_s = distilled_views(setup, trained, scene, budget, count, log)
    trained.field.widen(model.channels, setup.generator())

    renderer = stage2.make(setup)
    generator = setup.generator()
    pipeline = Pipeline(trained, scene.background, renderer, model)
    patches = Patches(pipeline, scene, distilled, joint, generator)
    training = JointTraining(renderer, patches, steps, trained if patches.learning else None)
    training.seconds = distilled_s
    training.meter = meter

    with meter:
        loop.train(training, finished, "training the 2D renderer", log)
    if not renderer.alive():
        why = f"the 2D renderer draws nothing but its base: its units died in training ({finished})"
        raise SteerbenchError(f"{why}. {training.advice}")
    trained.field.requires_grad_(False).gradients = None
    renderer.requires_grad_(False)
    return pipeline, key, training.seconds, training.peak_bytes


class JointTraining(loop.Training):
    """Stage 2: trains `renderer` in place, on patches from `patches`, and the field `trained`,
    unless that is None: then it is frozen."""

    advice = "Try smaller learning rates (method.joint.rate, method.joint.field_rate)."

    def __init__(
        self, renderer: UNet, patches: Patches, steps: int, trained: TrainedField | None
    ) -> None:
        self.renderer, self.patches, self.steps, self.trained = renderer, patches, steps, trained
        self.options, self.generator = patches.options, patches.generator
        if trained is not None:
            self.field_optimiser = FieldOptimiser(trained.field)
            seed = self.generator.initial_seed()
            self._visits = torch.Generator(trained.field.device).manual_seed(seed)

    def optimisers(self) -> Optimisers:
        return {**self._of_renderer, **(self.field_optimiser.parts if self.trained else {})}

    @cached_property
    def _of_renderer(self) -> dict[str, torch.optim.Optimizer]:
        """Created when first needed, like that of the field."""
        parameters, rate = list(self.renderer.parameters()), self.options.rate
        if self.options.optimiser == "adam":
            return {"adam": torch.optim.Adam(parameters, lr=rate, fused=True)}
        weights = [x for x in parameters if x.dim() == 4]
        others = [x for x in parameters if x.dim() != 4]
        return {"adam": torch.optim.Adam(others, lr=rate, fused=True), "muon": Muon(weights, rate)}

    def advance(self) -> dict[str, float]:
        """Take one step; return the error of the pictures. The density grid follows the field."""
        if self.trained and self.options.grid_samples and self.step % EVERY == 0:
            grid = self.trained.grid
            grid.update(self.trained.field, self._visits, self.options.grid_samples)
            self.patches.pipeline.occupancy = grid.occupancy
        batch = self.patches.draw(self.options.batch)
        kind = batch.truth.device.type
        with torch.autocast(kind, torch.bfloat16, enabled=multiplies_bf16(kind)):
            pictures = self.renderer(batch.observations)
        truth = batch.truth
        if any(mask is not None for mask in self.patches.masks):
            pictures, truth = loop.as_known(pictures, truth)
        loss = error = functional.mse_loss(pictures, truth)
        if self.trained and len(batch.opacity):
            loss = error + self.options.opacity_entropy * opacity_entropy(batch.opacity)
        loss.backward()
        errors = loop.look(self, lambda: {"": error}, {"loss": error, "picture": pictures})
        rate = self.rate_now(self.options.rate)
        for name, optimiser in self._of_renderer.items():
            loop.step_at(optimiser, MUON * rate if name == "muon" else rate)
        if self.trained:
            self.field_optimiser.step(self.rate_now(self.options.field_rate))
        self.step += 1
        return errors

    def rate_now(self, first: float) -> float:
        """The learning rate of the next step, for one that starts at `first`."""
        final, waves = self.options.final_rate / first, self.options.half_waves
        return first * loop.cosine(self.step / self.steps, final, waves)

    def watched(self) -> Tensors:
        field = self.trained.field.named_parameters("field") if self.trained else ()
        return dict([*self.renderer.named_parameters("renderer"), *field])

    def result(self) -> Tensors:
        result = self.renderer.state_dict(prefix="renderer.")
        if self.trained:
            result |= self.trained.field.state_dict(prefix="field.")
            result["grid.density"] = self.trained.grid.density
        return result

    def restore_result(self, tensors: Tensors) -> None:
        self.renderer.load_state_dict(checkpoint.part(tensors, "renderer."))
        if self.trained:
            restore_field(self.trained.field, self.trained.grid, tensors)
            self.patches.pipeline.occupancy = self.trained.grid.occupancy

    def state(self) -> Tensors:
        tensors = super().state()
        tensors |= {f"patches.{name}": x for name, x in self.patches.state().items()}
        if self.trained:
            tensors["visits"] = self._visits.get_state()
        return tensors

    def restore(self, tensors: Tensors) -> None:
        super().restore(tensors)
        self.patches.restore(checkpoint.part(tensors, "patches."))
        if self.trained:
            self._visits.set_state(tensors["visits"].cpu())
