"""Plain Instant-NGP (Müller et al. 2022): a hash-grid field rendered at full resolution."""

from __future__ import annotations

from dataclasses import asdict

import torch

from bench.types import Budget, Camera, Frame, Log, Probe, Scene
from methods.fields import HashField, Precision
from methods.kernels import resolve
from methods.kernels.composite import STOP
from methods.kernels.encode import HashGrid
from methods.train import TrainingOptions, train_field, training_digest
from methods.volume import render_frame


class InstantNgp:
    """Instant-NGP as a `bench.types.Method`.

    Args:
        grid: shape of the hash table.
        training: how the field is trained.
        precision: "bf16" (packed table, bfloat16 networks) or "fp32".
        stop: transmittance at which a ray ends when rendering.
    """

    name = "ngp"
    memory = 0

    def __init__(
        self,
        *,
        grid: HashGrid,
        training: TrainingOptions,
        precision: Precision = "bf16",
        stop: float = STOP,
        backend: str = "auto",
        device: str = "auto",
        seed: int = 0,
    ) -> None:
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        if precision == "bf16" and grid.features != 2:
            raise ValueError(
                f"precision bf16 packs 2 features an entry, grid.features is {grid.features}: "
                "use precision=fp32"
            )
        self.device = torch.device(device)
        self.backend = resolve(backend, self.device)
        self.grid, self.training, self.precision = grid, training, precision
        self.stop, self.seed = stop, seed
        self.train_s = 0.0

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        """Train the field, or load the one that the same training left behind."""
        generator = torch.Generator().manual_seed(self.seed)
        self.field = HashField(
            self.grid, precision=self.precision, backend=self.backend, generator=generator
        ).to(self.device)
        folder = log.stage_dir("field", self._training_key(scene, budget))
        density, self.train_s = train_field(
            self.field, scene, budget, self.training, self.seed, folder, log
        )
        self.occupancy = density.occupancy
        self.background = scene.background.to(self.device)

    def reset(self) -> None:
        """Nothing to forget: every frame stands alone."""

    @torch.no_grad()
    def render(self, camera: Camera, probe: Probe) -> Frame:
        """One frame at the camera's full resolution."""
        frame = render_frame(
            self.field, camera, self.occupancy, self.background, probe, stop=self.stop
        )
        return Frame(frame.values, frame.depth, frame.alpha)

    def sizes(self) -> dict[str, int]:
        """Bytes of table, networks and occupancy bits."""
        return self.field.sizes() | {"occupancy": self.occupancy.cells.numel() // 8}

    def settings(self) -> dict[str, str]:
        """See `bench.types.Method.settings`."""
        return {
            "device": str(self.device),
            "backend": self.backend,
            "engine": "torch",
            "precision": self.precision,
        }

    def _training_key(self, scene: Scene, budget: Budget) -> dict[str, object]:
        return {
            "scene": scene.digest,
            "steps": budget.steps,
            "samples": budget.samples,
            "grid": asdict(self.grid),
            "training": asdict(self.training),
            "precision": self.precision,
            "backend": self.backend,
            "device": self.device.type,
            "threads": torch.get_num_threads(),
            "seed": self.seed,
            "code": training_digest(),
        }
