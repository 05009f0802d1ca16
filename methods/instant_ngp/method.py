"""Plain Instant-NGP (Müller et al. 2022): a hash-grid field rendered at full resolution."""

from dataclasses import dataclass, replace

import torch

from bench.cameras import place_camera
from bench.study import turned
from bench.threads import torch_threads
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.instant_ngp.stage1 import MARCHED, OnField, train_field
from methods.kernels.compilation import compile_kernels
from methods.kernels.settings import Stop
from methods.rendering.frame import everywhere, render_frame


@dataclass(kw_only=True, eq=False)
class InstantNgp(OnField):
    """Instant-NGP as a `bench.types.Method`: the field of a `Setup`, rendered with rays that end at
    the transmittance `stop`, less than 1."""

    stop: Stop

    name = "ngp"
    study = replace(
        MARCHED,
        trained={
            "log2 T, trained": turned("log2 T", "method.grid.log2_table", (17, 18, 19)),
            "step, trained": turned("trained step", "method.training.march_step", (1, 2, 4)),
            "stop, trained": turned("trained stop", "method.training.stop", ("1e-2", "1e-4")),
            "thin, trained": turned("thin", "method.training.thin", (0,)),
            "error, trained": turned("by error", "method.training.by_error", (0,)),
        },
    )

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        self.compile_s = compile_kernels(type(self), self.setup.backend, log)
        with torch_threads(budget.threads):
            self.trained = train_field(self.setup, scene, budget, log)
        self.train_s = self.trained.train_s
        self.train_peak_bytes = self.trained.train_peak_bytes
        self.background = scene.background.to(self.setup.device)

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        camera = place_camera(camera, self.setup.device)
        field, occupancy = self.trained.field, self.trained.occupancy
        sampling = replace(self.trained.sampling, stop=self.stop)
        render = everywhere(field, occupancy, probe, sampling)
        return render_frame(camera, occupancy, self.background, probe, render).picture()

    def sizes(self) -> dict[str, int]:
        return self.trained.sizes()
