"""Trainings that go wrong, and data that there is nothing, or too little, to learn from."""

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
from bench.stress import StressCase
from bench.types import Budget, Camera, Scene, Split, SteerbenchError
from methods.instant_ngp.field import LOG_DENSITY_CLAMP, HashField, Precision
from methods.instant_ngp.training import MIN_RAYS, FieldTraining, TrainingOptions
from methods.kernels.adam import AdamState, sparse_adam_
from methods.kernels.case import U16, U32, on_backends
from methods.kernels.composite import composite
from methods.kernels.encode import HashGrid
from methods.rendering.occupancy import DECAY, THRESHOLD, DensityGrid
from methods.training import loop

GRID = HashGrid(levels=4, log2_table=8, n_min=4, n_max=16)
STEPS = 6
BY = [("reference", "fp32"), ("cpu", "fp32"), ("cpu", "bf16")]
HOLDS = dict.fromkeys(BY, 0.0)
BOOLEAN = "it does, or does not: 0"

QUICK = TrainingOptions(grid_samples=1 << 12, max_rays=MIN_RAYS)

FORGOTTEN_AFTER = math.ceil((LOG_DENSITY_CLAMP - math.log(THRESHOLD)) / -math.log(DECAY))
"""Visits after which a cell that was as dense as can be counts as empty."""


def cases() -> list[StressCase]:
    """Data that teach nothing; rates, weights and gradients beyond all measure."""
    data: dict[str, Callable[[], Scene]] = {
        "nothing but background": partial(_scene, 0, alpha=0),
        "all white": partial(_scene, 255),
        "all black": partial(_scene, 0),
        "pictures of one pixel": partial(_scene, 128, size=1),
        "all cameras the same": partial(_scene, 128, apart=0.0),
    }
    found = [
        StressCase(
            "training",
            name,
            f"losses and all that is learned stay finite for {STEPS} steps",
            BOOLEAN,
            HOLDS,
            partial(_stays_finite, make),
        )
        for name, make in data.items()
    ]
    found += [
        StressCase(
            "training",
            f"learning rate {rate:g}",
            "it stays finite, or stops with a SteerbenchError and a good last state",
            BOOLEAN,
            HOLDS,
            partial(_keeps_a_good_state, rate),
        )
        for rate in (10.0, 1e10, 1e30)
    ]
    found += [
        StressCase(
            "training",
            f"{value} in the table",
            "the next step stops with a SteerbenchError that names the table",
            BOOLEAN,
            HOLDS,
            partial(_reports, value),
        )
        for value in (math.nan, math.inf)
    ]
    found += [
        StressCase(
            "training",
            "gradients 1e-20 as large",
            "they do not vanish: 1e-20 of what they were",
            "a factor in front of sums: float32 and bfloat16 have the exponents; 5 layers of "
            "roundings of size 1: 16 u, in bf16 5 ulp",
            {(b, p): 16 * U32 if p == "fp32" else 5 * U16 for b, p in BY},
            _shrunk_gradient_error,
        ),
        StressCase(
            "density grid",
            "field explodes, then is empty",
            f"no cell counts as occupied after {FORGOTTEN_AFTER} visits",
            BOOLEAN,
            HOLDS,
            _unforgotten,
        ),
    ]
    found += [
        StressCase(
            "field",
            f"log density {raw:g}",
            "pixels, opacity and gradients are finite",
            BOOLEAN,
            HOLDS,
            partial(_extreme_density, raw),
        )
        for raw in (-1e4, -100.0, 100.0, 1e4)
    ]
    found += [
        StressCase(
            "adam",
            f"first gradient {gradient:g}",
            "the step is that of the closed form",
            "moments, corrections, root, quotient and sum: 16 u of rates of 1",
            on_backends(16),
            partial(_adam_error, gradient),
        )
        for gradient in (0.0, 1e-40, 1e-30, 1e-15, 1.0, 1e15)
    ]
    return found


def _scene(level: int, *, alpha: int = 255, size: int = 8, apart: float = 1.0) -> Scene:
    """Pictures of one `level`, from all around."""
    cameras, up = [], torch.tensor([0.0, 0.0, 1.0])
    for view in range(6):
        angle = apart * math.pi * view / 3
        away = torch.tensor([math.cos(angle), math.sin(angle), 0.3])
        c2w = look_at(0.5 + 1.3 * away, torch.full((3,), 0.5), up)
        cameras.append(Camera(c2w, size, size, size / 2, size / 2, size, size))
    image = torch.full((size, size, 4), level, dtype=torch.uint8)
    image[..., 3] = alpha
    split = Split(cameras, [image] * 6, [str(view) for view in range(6)])
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("flat", {"train": split, "test": split}, torch.ones(3), bounds, 1.0, "flat")


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
    losses = [training.advance()[""] for _ in range(STEPS)]
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
    pixels = composite(sigma, values, t, torch.full_like(t, 1 / 16), offsets, backend=field.backend)
    return pixels.values.sum() + pixels.depth_sum.sum() + pixels.alpha.sum()


def _shrunk_gradient_error(backend: str, device: str, precision: str) -> float:
    """Of all parameters, over the largest of each."""
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
                grid.update(field, generator, 256)  # every one of the four cells
    return float(grid.occupancy.cells.sum())


def _adam_error(gradient: float, backend: str, device: str, precision: str) -> float:
    table = torch.zeros(3, 2, device=device)
    grad = torch.full_like(table, gradient)
    exact = grad[0, 0].item()  # as float32 has it
    sparse_adam_(table, grad, AdamState.like(table), 1.0, backend=backend)
    want = -exact / (abs(exact) + 1e-15)
    error = (table.double() - want).abs().max().item()
    return math.inf if math.isnan(error) else error
