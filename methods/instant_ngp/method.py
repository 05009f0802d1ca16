"""Plain Instant-NGP (Müller et al. 2022): a hash-grid field rendered at full resolution."""

from __future__ import annotations

import torch

from bench.cameras import place_camera
from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.instant_ngp.field import Precision
from methods.instant_ngp.stage1 import Setup, pretrain
from methods.instant_ngp.training import TrainingOptions
from methods.kernels.composite import STOP, check_stop
from methods.kernels.encode import HashGrid
from methods.steernerf.buffer import Cloud, Reprojection
from methods.steernerf.range_reduction import RangeReduction, evidence, render_guided


class InstantNgp:
    """Instant-NGP as a `bench.types.Method`.

    Args:
        grid: shape of the hash table.
        training: how the field is trained.
        precision: "bf16" (packed table, bfloat16 networks) or "fp32".
        stop: transmittance at which a ray ends when rendering, less than 1.
        range: where rays look, given the depth of the preceding frame; null: every frame stands
            alone.
        name: as it stands in result rows.
    """

    def __init__(
        self,
        *,
        grid: HashGrid,
        training: TrainingOptions,
        precision: Precision = "bf16",
        stop: float = STOP,
        range: RangeReduction | None = None,
        name: str = "ngp",
        backend: str = "auto",
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        self.setup = Setup.resolved(grid, training, precision, backend, device, seed)
        check_stop(stop)
        self.stop, self.name = stop, name
        self.range = range if range is not None and range.mode != "off" else None
        self.memory = 0 if self.range is None else 1
        self.reprojection = Reprojection()
        self.preceding: Cloud | None = None
        self.train_s = 0.0

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train the field, or load the one that the same training left behind."""
        self.trained = pretrain(self.setup, scene, budget, log)
        self.train_s = self.trained.train_s
        self.background = scene.background.to(self.setup.device)

    def reset(self) -> None:
        """Forget the preceding frame."""
        self.preceding = None

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        """One frame at the camera's full resolution."""
        field, occupancy = self.trained.field, self.trained.occupancy
        camera = place_camera(camera, self.setup.device)
        found = None
        if self.range is not None and self.preceding is not None:
            with probe.stage("depth_reprojection"):
                found = evidence(
                    self.preceding, camera, self.range, self.reprojection, field.backend
                )
        frame = render_guided(
            field, camera, occupancy, self.background, probe, found, stop=self.stop
        )
        if self.range is not None:
            with probe.stage("depth_reprojection"):
                self.preceding = Cloud.of(frame, self.reprojection)
        return Frame(frame.values, frame.depth, frame.alpha)

    def sizes(self) -> dict[str, int]:
        """Bytes of table, networks and occupancy bits."""
        return self.trained.sizes()

    def settings(self) -> dict[str, str]:
        """See `bench.types.Method.settings`."""
        return self.setup.settings()
