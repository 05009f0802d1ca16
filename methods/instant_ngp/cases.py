"""Test cases of fields and their training: a whole step on all backends, bad data, extremes."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from bench.cameras import look_at
from bench.case import U16, U32, Agreement, Case, Property
from bench.types import Budget, Camera, Scene, Split, SteerbenchError, Unavailable
from methods.instant_ngp.field import LOG_DENSITY_CLAMP, HashField, Precision
from methods.instant_ngp.training import MIN_RAYS, FieldTraining, TrainingOptions
from methods.kernels import BACKENDS
from methods.kernels.composite import composite
from methods.kernels.encode import HashGrid
from methods.kernels.types import Intervals, Occupancy
from methods.rendering.occupancy import DECAY, RESOLUTION, THRESHOLD, DensityGrid
from methods.training import loop

SAMPLES = 1 << 14
RAYS = 1500
"""Rays that have about `SAMPLES` samples in the hollow sphere below."""

GRID = HashGrid(levels=4, log2_table=8, n_min=4, n_max=16)
STEPS = 6
BY = [("reference", "fp32"), ("cpu", "fp32"), ("cpu", "bf16")]

QUICK = TrainingOptions(grid_samples=1 << 12, max_rays=MIN_RAYS)

FORGOTTEN_AFTER = math.ceil((LOG_DENSITY_CLAMP - math.log(THRESHOLD)) / -math.log(DECAY))
"""Visits after which a cell of the largest possible density counts as empty again."""


def cases() -> list[Case]:
    """The training step, timed; constant data; extreme rates, weights and gradients."""
    step = Agreement("training step", BACKENDS, "a loss below 1 of pixels behind 5 bf16 layers")
    data: dict[str, Callable[[], Scene]] = {
        "nothing but background": partial(_scene, 0, alpha=0),
        "all white": partial(_scene, 255),
        "all black": partial(_scene, 0),
        "pictures of one pixel": partial(_scene, 128, size=1),
        "all cameras the same": partial(_scene, 128, apart=0.0),
    }

    def property_of(subject: str, holds: str) -> Property:
        return Property(subject, holds, "it does, or does not: 0", dict.fromkeys(BY, 0.0))

    finite = property_of("training", f"losses and parameters stay finite for {STEPS} steps")
    stops = property_of(
        "training", "it stays finite, or stops with a SteerbenchError and a good last state"
    )
    reports = property_of(
        "training", "the next step stops with a SteerbenchError that names the table"
    )
    forgotten = f"no cell counts as occupied after {FORGOTTEN_AFTER} visits"
    pixels = property_of("field", "pixels, opacity and gradients are finite")
    shrunk = Property(
        "training",
        "they do not vanish: 1e-20 of what they were",
        "a factor in front of sums: float32 and bfloat16 have the exponents; 5 layers of "
        "roundings of size 1: 16 u, in bf16 5 ulp",
        {(b, p): 16 * U32 if p == "fp32" else 5 * U16 for b, p in BY},
    )
    return [
        step.case("T=2^17", _prepare_step, 5 * U16, precision="bf16", items=SAMPLES),
        *(finite.case(name, partial(_stays_finite, make)) for name, make in data.items()),
        *(
            stops.case(f"learning rate {rate:g}", partial(_keeps_a_good_state, rate))
            for rate in (10.0, 1e10, 1e30)
        ),
        *(
            reports.case(f"{value} in the table", partial(_reports, value))
            for value in (math.nan, math.inf)
        ),
        shrunk.case("gradients 1e-20 as large", _shrunk_gradient_error),
        property_of("density grid", forgotten).case("field explodes, then is empty", _unforgotten),
        *(
            pixels.case(f"log density {raw:g}", partial(_extreme_density, raw))
            for raw in (-1e4, -100.0, 100.0, 1e4)
        ),
    ]


def _prepare_step(device: str) -> Callable[[str], tuple[Tensor, ...]]:
    """One step of an untrained field in a hollow sphere, with the same batch for every backend."""
    trainings: dict[str, FieldTraining] = {}
    scene, occupancy = _noise_scene(), _hollow_sphere(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        if backend not in trainings:
            generator = torch.Generator().manual_seed(0)
            field = HashField(HashGrid(log2_table=17), backend=backend, generator=generator)
            budget = Budget("step", steps=1000, samples=SAMPLES)
            trainings[backend] = FieldTraining(
                field.to(device), scene, budget, TrainingOptions(), seed=0
            )
        training = trainings[backend]
        # A step that does not update the grid, but whose error is read back.
        training.step, training.rays = loop.LOOK_EVERY, RAYS
        training.generator.manual_seed(0)
        training.grid.occupancy = occupancy
        training.advance()
        assert training.asked is not None
        return (torch.tensor(training.asked.tell()[""]),)

    return call


def _hollow_sphere(device: str) -> Occupancy:
    axis = (torch.arange(RESOLUTION, device=device) + 0.5) / RESOLUTION - 0.5
    radius = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2).sqrt()
    return Occupancy((radius > 0.33) & (radius < 0.35))


def _noise_scene() -> Scene:
    """Pictures of noise, taken on a circle around the unit cube."""
    generator = torch.Generator().manual_seed(0)
    cameras, images = [], []
    for view in range(8):
        angle = math.pi * view / 4
        away = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
        cameras.append(Camera(_towards_the_middle(-away), 70.0, 70.0, 32.0, 32.0, 64, 64))
        images.append(torch.randint(256, (64, 64, 4), dtype=torch.uint8, generator=generator))
    return _of_pictures(cameras, images)


def _scene(level: int, *, alpha: int = 255, size: int = 8, apart: float = 1.0) -> Scene:
    """Pictures of a single grey `level`, from all around."""
    cameras = []
    for view in range(6):
        angle = apart * math.pi * view / 3
        away = torch.tensor([math.cos(angle), math.sin(angle), 0.3])
        cameras.append(
            Camera(_towards_the_middle(away), size, size, size / 2, size / 2, size, size)
        )
    image = torch.full((size, size, 4), level, dtype=torch.uint8)
    image[..., 3] = alpha
    return _of_pictures(cameras, [image] * 6)


def _towards_the_middle(away: Tensor) -> Tensor:
    """The pose of a camera in direction `away` from the middle of the cube, looking at it."""
    return look_at(0.5 + 1.3 * away, torch.full((3,), 0.5), torch.tensor([0.0, 0.0, 1.0]))


def _of_pictures(cameras: list[Camera], images: list[Tensor]) -> Scene:
    split = Split(cameras, images, [str(view) for view in range(len(images))])
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("stress", {"train": split, "test": split}, torch.ones(3), bounds, 1.0, "stress")


def _field(backend: str, device: str, precision: str) -> HashField:
    generator = torch.Generator().manual_seed(0)
    kind: Precision = "bf16" if precision == "bf16" else "fp32"
    field = HashField(GRID, precision=kind, backend=backend, generator=generator)
    return field.to(device)


def _training(
    scene: Scene, options: TrainingOptions, backend: str, device: str, precision: str
) -> FieldTraining:
    field = _field(backend, device, precision)
    training = FieldTraining(field, scene, Budget("stress", STEPS, samples=512), options, seed=0)
    training.rays = MIN_RAYS
    return training


def _stays_finite(make: Callable[[], Scene], backend: str, device: str, precision: str) -> float:
    training = _training(make(), QUICK, backend, device, precision)
    losses = [loss for _ in range(STEPS) for loss in training.advance().values()]
    loop.check_finite(training)
    return 0.0 if all(map(math.isfinite, losses)) else math.inf


def _keeps_a_good_state(rate: float, backend: str, device: str, precision: str) -> float:
    options = replace(QUICK, rate=rate)
    new = partial(_training, _scene(128), options, backend, device, precision)
    with tempfile.TemporaryDirectory() as folder:
        kept, training = Path(folder) / "kept.safetensors", new()
        loop.save(training, kept)
        try:
            for _ in range(STEPS):
                training.advance()
                loop.save(training, kept)
        except Unavailable:  # the training did not break down
            raise
        except SteerbenchError:
            training = new()
            loop.resume(training, kept)
    loop.check_finite(training)
    return 0.0


def _reports(value: float, backend: str, device: str, precision: str) -> float:
    training = _training(_scene(128), QUICK, backend, device, precision)
    with torch.no_grad():
        training.field.table.fill_(value)
        training.field.repack()
    try:
        training.advance()
    except Unavailable:
        raise
    except SteerbenchError as error:
        return 0.0 if "table" in str(error) else math.inf
    return math.inf


def _rendered(field: HashField, device: str) -> Tensor:
    """Sum of all numbers of the pixels of 8 rays of 16 samples."""
    generator = torch.Generator().manual_seed(0)
    positions = torch.rand(128, 3, generator=generator).to(device)
    sigma, geometry = field.density(positions)
    directions = torch.ones(128, 3, device=device)
    values = field.features(geometry, field.encode_directions(directions))
    t = torch.linspace(1, 2, 16, device=device).repeat(8)
    offsets = torch.arange(0, 129, 16, device=device)
    intervals = Intervals(t, torch.full_like(t, 1 / 16), offsets)
    pixels = composite(sigma, values, intervals, backend=field.backend)
    return pixels.values.sum() + pixels.depth_sum.sum() + pixels.alpha.sum()


def _shrunk_gradient_error(backend: str, device: str, precision: str) -> float:
    """Largest error of the gradients of all parameters, relative to the largest of each."""
    field = _field(backend, device, precision)
    learned = list(field.parameters())
    whole = torch.autograd.grad(_rendered(field, device), learned)
    shrunk = torch.autograd.grad(1e-20 * _rendered(field, device), learned)
    return max(
        ((1e20 * s.double() - w.double()).abs().max() / w.abs().max()).item()
        for s, w in zip(shrunk, whole, strict=True)
    )


def _extreme_density(raw: float, backend: str, device: str, precision: str) -> float:
    field = _field(backend, device, precision)
    with torch.no_grad():
        field.table.fill_(1.0)
        field.layers["density_in"].fill_(1 / GRID.channels)
        field.layers["density_out"].fill_(raw / len(field.layers["density_in"]))
        field.repack()
    total = _rendered(field, device)
    gradients = torch.autograd.grad(total, list(field.parameters()))
    return 0.0 if all(x.isfinite().all() for x in (total, *gradients)) else math.inf


def _unforgotten(backend: str, device: str, precision: str) -> float:
    """Cells that count as occupied after the field was infinitely dense, and then empty."""
    cells = torch.zeros(128, 128, 128, dtype=torch.bool, device=device)
    cells[0, 0, :4] = True
    grid, field = DensityGrid(cells), _field(backend, device, precision)
    generator = torch.Generator(device).manual_seed(0)
    with torch.no_grad():
        field.table.fill_(1.0)
        field.layers["density_in"].fill_(1.0)
        for weight, updates in ((1e4, 1), (-1e4, FORGOTTEN_AFTER)):
            field.layers["density_out"].fill_(weight)
            field.repack()
            for _ in range(updates):
                grid.update(field, generator, 256)  # visits all four cells
    return float(grid.occupancy.cells.sum())
