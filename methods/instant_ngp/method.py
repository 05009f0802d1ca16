"""Plain Instant-NGP (Müller et al. 2022): a hash-grid field rendered at full resolution."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from bench.cameras import place_camera
from bench.study import Study, turned
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.instant_ngp.field import FieldPrecision
from methods.instant_ngp.stage1 import Setup, train_field
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.composite import check_stop
from methods.kernels.encode import HashGrid
from methods.rendering.frame import everywhere, render_frame


@dataclass(kw_only=True, eq=False)
class InstantNgp:
    """Instant-NGP as a `bench.types.Method`: the field of a `Setup`, rendered with rays that end at
    the transmittance `stop`, less than 1."""

    grid: HashGrid
    training: TrainingOptions
    precision: FieldPrecision
    stop: float
    backend: str
    device: str
    seed: int

    name, memory = "ngp", 0
    study = Study(
        knobs={"stop": turned("stop", "method.stop", ("1e-1", "1e-2", "1e-3"))},
        trained={
            "log2 T, trained": turned("log2 T", "method.grid.log2_table", (17, 18, 19)),
            "step, trained": turned("trained step", "method.training.march_step", (1, 2, 4)),
            "stop, trained": turned("trained stop", "method.training.stop", ("1e-2", "1e-4")),
            "thin, trained": turned("thin", "method.training.thin", (0,)),
            "error, trained": turned("by error", "method.training.by_error", (0,)),
        },
        exact=("method.stop=1e-4",),
        parts=dict.fromkeys(("rays", "march", "composite"), "field"),
        chosen=("stop",),
    )

    def __post_init__(self) -> None:
        where = self.backend, self.device, self.seed
        self.setup = Setup.resolved(self.grid, self.training, self.precision, *where)
        check_stop(self.stop)
        self.train_s = 0.0

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        with torch_threads(budget.threads):
            self.trained = train_field(self.setup, scene, budget, log)
        self.train_s = self.trained.train_s
        self.background = scene.background.to(self.setup.device)

    def reset(self) -> None:
        """Do nothing: every frame stands alone."""

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        camera = place_camera(camera, self.setup.device)
        field, occupancy = self.trained.field, self.trained.occupancy
        sampling = replace(self.trained.sampling, stop=self.stop)
        render = everywhere(field, occupancy, probe, sampling)
        return render_frame(camera, occupancy, self.background, probe, render).picture()

    def sizes(self) -> dict[str, int]:
        return self.trained.sizes()

    def settings(self) -> dict[str, str]:
        return self.setup.settings(type(self))
