"""A method whose model starts from a trained field, then learns from the photos."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import ClassVar

import torch

from bench.cameras import place_camera
from bench.errors import unexpected
from bench.provenance import computed_by
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.instant_ngp.stage1 import MARCHED, Setup, TrainedField, train_field
from methods.instant_ngp.training import PixelOptions
from methods.kernels.compilation import compile_kernels
from methods.kernels.settings import Checked, Steps, Stop
from methods.rendering.frame import Renderer, render_frame
from methods.training import checkpoint, loop
from methods.training.checkpoint import Tensors

IN_FP32 = {"field_precision": "fp32"}
"""`Student.computed` of a model whose products are of float32, whatever those of its teacher."""


@dataclass(kw_only=True, eq=False)
class Student(Checked, ABC):
    """Base of the methods that start from the Instant-NGP field that all methods share. `train_s`
    counts the training of the field, the initialisation of the model and its own training."""

    teacher: Setup  # the field that it starts from, and where it runs
    training: PixelOptions  # how the model is trained
    stop: Stop  # transmittance at which a ray ends when rendering, less than 1
    name: str  # as shown in result rows
    steps: Steps  # of its own training; None: `budget.renderer_steps`

    memory, train_s = 0, 0.0
    kind: ClassVar[str]  # name of its trained stage, for example "nerf"
    model: ClassVar[Sequence[str]] = ()  # its settings that its training depends on
    computed: ClassVar[Mapping[str, str]] = {}  # what rows say of it but not of its teacher
    contracts: ClassVar[bool] = True  # whether it can be trained in contracted space
    study = MARCHED

    @abstractmethod
    def begin(self, teacher: TrainedField, scene: Scene, budget: Budget) -> loop.Training:
        """Make the training of the model, as it is before its first step."""

    @abstractmethod
    def restore(self, tensors: Tensors) -> None:
        """Load the `result` of a training, to render it."""

    @abstractmethod
    def renderer(self, probe: Probe) -> Renderer:
        """The cells that may show anything, and what renders the pixels that may see them."""

    @abstractmethod
    def sizes(self) -> dict[str, int]:
        """Bytes of what is rendered, by component."""

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        camera = place_camera(camera, self.teacher.device)
        occupancy, render = self.renderer(probe)
        return render_frame(camera, occupancy, self.background, probe, render).picture()

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        budget = replace(budget, renderer_steps=self.steps or budget.renderer_steps)
        self.contracted = scene.space == "all"
        if self.contracted and not self.contracts:
            straight = "a scene of space=box: its rays cross voxels in straight lines"
            raise unexpected(f"method={self.kind}", straight, f"space=all of {scene.name}")
        self.compile_s = compile_kernels(type(self), self.teacher.backend, log)
        with torch_threads(budget.threads):
            teacher = train_field(self.teacher, scene, budget, log)
            settings = asdict(self)
            key = {
                "field": self.teacher.key(scene, budget),
                "steps": budget.renderer_steps,
                "model": {name: settings[name] for name in self.model},
                "training": settings["training"],
                **computed_by(type(self)),
            }
            finished = log.stage_dir(self.kind, key) / f"{self.kind}.safetensors"
            begin = partial(self.begin, teacher, scene, budget)
            device = self.teacher.device
            tensors, seconds, peak = loop.trained(begin, finished, self.kind, device, log)
            with checkpoint.restoring(finished):
                self.restore(tensors)
        self.train_s = teacher.train_s + seconds
        self.train_peak_bytes = max(teacher.train_peak_bytes, peak)
        self.background = scene.background.to(self.teacher.device)

    def reset(self) -> None:
        """Do nothing: every frame stands alone."""

    def settings(self) -> dict[str, str]:
        return {**self.teacher.settings(type(self)), **self.computed}
