"""3D Gaussian Splatting, as a `bench.types.Method`."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch

from bench.cameras import place_camera
from bench.provenance import computed_by
from bench.study import Axis, Study, Variant, turned
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.gaussians import ply
from methods.gaussians.model import Gaussians, rounded, stored_bytes
from methods.gaussians.training import Fitting, GaussianTraining, on_surfaces, spacing
from methods.instant_ngp.stage1 import OnField, train_field
from methods.kernels.compilation import compile_kernels
from methods.kernels.settings import Count, Degree, Steps, Stop
from methods.rendering.frame import FeatureFrame
from methods.training import checkpoint, loop


@dataclass(kw_only=True, eq=False)
class GaussianSplatting(OnField):
    """3D Gaussians, with the settings of `sweeps/configs/method/gaussians.yaml`; `grid`, `training`
    and `precision` are those of the field that they start from."""

    fitting: Fitting
    count: Count
    steps: Steps  # None: `budget.renderer_steps`
    degree: Degree
    checkpoint: str | None
    stored: Literal["fp32", "int8"]
    stop: Stop
    name: str

    study = Study(
        knobs={
            "stop": turned("stop", "method.stop", ("1e-1", "1e-2", "1e-3")),
            "stored": [Variant("stored int8", ("method.stored=int8",))],
        },
        trained={
            "number, trained": [Variant(f"{n:,}", (f"method.count={n}",)) for n in (20_000, 40_000)]
        },
        exact=("method.stop=1e-4", "method.stored=fp32"),
        axes={"N": Axis("{:,} Gaussians", "method.count", (20_000, 40_000, 80_000, 160_000))},
        chosen=("stored", "stop"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        self.reads = [] if self.checkpoint is None else [Path(self.checkpoint)]

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train field and Gaussians, load what was trained before, or read the `checkpoint`."""
        self.compile_s = compile_kernels(type(self), self.setup.backend, log)
        if self.reads:
            gaussians = ply.read(self.reads[0], scene, log.info).to(self.setup.device)
        else:
            with torch_threads(budget.threads):
                gaussians = self._trained(scene, budget, log)
        self.gaussians = gaussians if self.stored == "fp32" else rounded(gaussians)
        self.background = scene.background.to(self.setup.device)

    def _trained(self, scene: Scene, budget: Budget, log: Log) -> Gaussians:
        setup = self.setup
        steps = self.steps or budget.renderer_steps
        teacher = train_field(setup, scene, budget, log)
        key = {
            "field": setup.key(scene, budget),
            "steps": steps,
            "fitting": asdict(self.fitting),
            "count": self.count,
            "degree": self.degree,
            **computed_by(type(self)),
        }
        finished = log.stage_dir("gaussians", key) / "gaussians.safetensors"

        def begin() -> GaussianTraining:
            generator = setup.generator(setup.device)
            points, colours = on_surfaces(teacher, scene, self.count, generator)
            scales = self.fitting.size * spacing(points)
            untrained = Gaussians.at(points, colours, scales, self.fitting.opacity, self.degree)
            return GaussianTraining(untrained, scene, steps, self.fitting, setup)

        tensors, seconds, peak = loop.trained(begin, finished, "gaussians", setup.device, log)
        with checkpoint.restoring(finished):
            gaussians = Gaussians(**tensors).to(setup.device)
        self.train_s = teacher.train_s + seconds
        self.train_peak_bytes = max(teacher.train_peak_bytes, peak)
        if not (exported := finished.with_suffix(".ply")).exists():
            ply.write(gaussians, scene, exported)
            log.info(f"Gaussians for other programs: {exported}")
        return gaussians

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        camera = place_camera(camera, self.setup.device)
        pixels = self.gaussians.render(camera, self.stop, probe, self.setup.backend)
        with probe.stage("finish"):
            return FeatureFrame.of(camera, pixels, self.background).picture()

    def sizes(self) -> dict[str, int]:
        plain = sum(4 * x.numel() for x in self.gaussians.parameters())
        return {"gaussians": plain if self.stored == "fp32" else stored_bytes(self.gaussians)}

    def settings(self) -> dict[str, str]:
        return super().settings() | {"field_precision": "fp32"}
