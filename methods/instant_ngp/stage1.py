"""The trained field of a scene: trained once and shared by every method that builds on it."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import torch

from bench.provenance import computed_by
from bench.study import Study, turned
from bench.types import DEVICE, Budget, Log, Scene
from methods.instant_ngp.field import FieldPrecision, HashField
from methods.instant_ngp.table import SuitedGrid
from methods.instant_ngp.training import FieldTraining, TrainingOptions, new_grid, restore_field
from methods.kernels import multiplies_bf16, resolve
from methods.kernels.dispatch import by_kernel
from methods.kernels.encode import HashGrid
from methods.kernels.settings import Checked
from methods.kernels.types import Occupancy
from methods.rendering.occupancy import STEP, DensityGrid
from methods.rendering.sampling import Sampling
from methods.training import checkpoint, loop

MARCHED = Study(
    knobs={"stop": turned("stop", "method.stop", ("1e-1", "1e-2", "1e-3"))},
    exact=("method.stop=1e-4",),
    parts=dict.fromkeys(("rays", "march", "composite"), "field"),
    chosen=("stop",),
)
"""The study of a field that rays are marched through."""


@dataclass(frozen=True)
class Setup:
    """What a field is and where it runs; see `resolved`."""

    grid: HashGrid  # shape of the hash table; `SuitedGrid`: the scene says how long it is
    training: TrainingOptions
    precision: FieldPrecision  # "bf16": packed table, bfloat16 networks
    backend: str
    device: torch.device
    seed: int  # of everything random in the training

    @classmethod
    def resolved(
        cls,
        grid: HashGrid,
        training: TrainingOptions,
        precision: FieldPrecision,
        backend: str,
        device: str,
        seed: int,
    ) -> Self:
        """Make a setup with `auto` replaced by what it means on this machine."""
        if not DEVICE.fullmatch(device):
            raise ValueError(f"device: expected auto, cpu, cuda or cuda:N, got {device!r}")
        if device == "auto":
            device = "cuda" if torch.cuda.is_available() else "cpu"
        if precision == "bf16" and grid.features != 2:
            raise ValueError(
                f"precision bf16 packs 2 features an entry, grid.features is {grid.features}: "
                "use precision=fp32"
            )
        place = torch.device(device)
        return cls(grid, training, precision, resolve(backend, place), place, seed)

    def generator(self, device: torch.device | str = "cpu") -> torch.Generator:
        """Random numbers of the seed."""
        return torch.Generator(device).manual_seed(self.seed)

    def settings(self, method: type) -> dict[str, str]:
        """What a row of `method` shows of how it ran, of one without a 2D network."""
        multiplied = self.precision == "fp32" or multiplies_bf16(self.device.type)
        return {
            "device": str(self.device),
            "backend": by_kernel(self.backend, method, self.device),
            "engine": "none",
            "precision": "none",
            "field_precision": self.precision if multiplied else "bf16 in fp32",
        }

    def suited(self, scene: Scene) -> Self:
        """This setup with the hash table that `scene` needs, if it leaves that to the scene."""
        grid = self.grid.of(scene) if isinstance(self.grid, SuitedGrid) else self.grid
        return replace(self, grid=grid)

    def key(self, scene: Scene, budget: Budget) -> Mapping[str, object]:
        """Everything the trained field depends on."""
        march_step = self.training.sampling(budget).step / STEP
        return {
            "scene": scene.digest,
            "steps": budget.steps,
            "samples": budget.samples,
            "grid": asdict(self.suited(scene).grid),
            "training": {**asdict(self.training), "march_step": march_step},
            "precision": self.precision,
            "backend": by_kernel(self.backend, train_field, self.device),
            "device": self.device.type,
            "seed": self.seed,
            **computed_by(train_field),
        }


@dataclass(kw_only=True, eq=False)
class OnField(Checked):
    """Base of methods whose settings are those of a field, see `Setup`, and others."""

    grid: HashGrid
    training: TrainingOptions
    precision: FieldPrecision
    backend: str
    device: str
    seed: int

    memory, train_s = 0, 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        where = self.backend, self.device, self.seed
        self.setup = Setup.resolved(self.grid, self.training, self.precision, *where)

    def reset(self) -> None:
        """Do nothing: every frame stands alone."""

    def settings(self) -> dict[str, str]:
        return self.setup.settings(type(self))

    def decided(self, scene: Scene) -> dict[str, Any]:
        """What settings that are left to the scene become for it, by the names that one types."""
        return {"method.grid.log2_table": self.setup.suited(scene).grid.log2_table}


@dataclass(frozen=True)
class TrainedField:
    """A trained field, the grid of its densities, how its rays are marched, and the seconds and the
    peak memory that its training took."""

    field: HashField
    grid: DensityGrid
    sampling: Sampling
    train_s: float
    train_peak_bytes: float = math.nan

    @property
    def occupancy(self) -> Occupancy:
        """Where the field may hold matter."""
        return self.grid.occupancy

    def sizes(self) -> dict[str, int]:
        """Bytes of table, networks and occupancy bits."""
        return self.field.sizes() | {"occupancy": self.occupancy.cells.numel() // 8}


def train_field(setup: Setup, scene: Scene, budget: Budget, log: Log) -> TrainedField:
    """Train a field on the pictures of `scene`, or load the result of the same training."""
    setup = setup.suited(scene)  # once: it reads pictures
    field = HashField(
        setup.grid,
        precision=setup.precision,
        backend=setup.backend,
        generator=setup.generator(),
    ).to(setup.device)
    finished = log.stage_dir("field", setup.key(scene, budget)) / "field.safetensors"

    def begin() -> FieldTraining:
        return FieldTraining(field, scene, budget, setup.training, setup.seed)

    tensors, *cost = loop.trained(begin, finished, "field", setup.device, log)
    grid = new_grid(scene, setup.device)
    field.gradients = None
    with checkpoint.restoring(finished):
        restore_field(field, grid, tensors)
    return TrainedField(field, grid, setup.training.sampling(budget), *cost)
