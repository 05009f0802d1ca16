"""Test cases of fields and their training: bad data, extreme rates, weights and gradients."""

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from bench.cameras import look_at
from bench.case import U16, U32, Cases, Property
from bench.types import Budget, Camera, Scene, Split, SteerbenchError, Unavailable
from methods.instant_ngp.field import LOG_DENSITY_CLAMP, FieldPrecision, HashField
from methods.instant_ngp.training import MIN_RAYS, FieldTraining, TrainingOptions
from methods.kernels.composite import composite
from methods.kernels.encode import HashGrid
from methods.kernels.types import Intervals
from methods.rendering.occupancy import DECAY, THRESHOLD, DensityGrid
from methods.training import loop

GRID = HashGrid(levels=4, features=2, log2_table=8, n_min=4, n_max=16)
STEPS = 6
BY = [("reference", "fp32"), ("cpu", "fp32"), ("cpu", "bf16")]

QUICK = TrainingOptions(
    rate=1e-2,
    final_rate=1 / 30,
    opacity_entropy=1e-3,
    random_background=True,
    max_rays=MIN_RAYS,
    by_error=0.5,
    march_step=None,
    share=0.5,
    grid_samples=1 << 12,
    rays=None,
    stop=3e-2,
    thin=1e-2,
)

FORGOTTEN_AFTER = math.ceil((LOG_DENSITY_CLAMP - math.log(THRESHOLD)) / -math.log(DECAY))
"""Visits after which a cell of the largest possible density counts as empty again."""


def cases() -> Cases:
    """Constant data; extreme rates, weights and gradients."""
    pictures = {
        "nothing but background": partial(_scene, 0, alpha=0),
        "all white": partial(_scene, 255),
        "all black": partial(_scene, 0),
        "pictures of one pixel": partial(_scene, 128, size=1),
        "all cameras the same": partial(_scene, 128, apart=0.0),
    }
    finite = _exactly("training", f"losses and parameters stay finite for {STEPS} steps")
    good = _exactly(
        "training", "it stays finite, or stops with a SteerbenchError and a good last state"
    )
    named = _exactly("training", "the next step stops with a SteerbenchError that names the table")
    shrunk = Property(
        "training",
        "they do not vanish: 1e-20 of what they were",
        "a factor in front of sums: float32 and bfloat16 have the exponents; 5 layers of "
        "roundings of size 1: 16 u, in bf16 5 ulp",
        {(b, p): 16 * U32 if p == "fp32" else 5 * U16 for b, p in BY},
    )
    holds = f"no cell counts as occupied after {FORGOTTEN_AFTER} visits"
    forgotten = _exactly("density grid", holds)
    rendered = _exactly("field", "pixels, opacity and gradients are finite")
    densities, rates = (-1e4, -100.0, 100.0, 1e4), (10.0, 1e10, 1e30)
    return [
        *(finite.case(name, _stays_finite, make) for name, make in pictures.items()),
        *(good.case(f"learning rate {r:g}", _keeps_a_good_state, r) for r in rates),
        *(named.case(f"{x} in the table", _reports, x) for x in (math.nan, math.inf)),
        shrunk.case("gradients 1e-20 as large", _shrunk_gradient_error),
        forgotten.case("field explodes, then is empty", _unforgotten),
        *(rendered.case(f"log density {x:g}", _extreme_density, x) for x in densities),
    ]


def _exactly(subject: str, holds: str) -> Property:
    return Property(subject, holds, "it does, or does not: 0", dict.fromkeys(BY, 0.0))


def _scene(level: int, *, alpha: int = 255, size: int = 8, apart: float = 1.0) -> Scene:
    """Pictures of a single grey `level`, from all around."""
    middle, up = torch.full((3,), 0.5), torch.tensor([0.0, 0.0, 1.0])
    cameras = []
    for view in range(6):
        angle = apart * math.pi * view / 3
        away = torch.tensor([math.cos(angle), math.sin(angle), 0.3])
        pose = look_at(0.5 + 1.3 * away, middle, up)
        cameras.append(Camera(pose, size, size, size / 2, size / 2, size, size))
    image = torch.full((size, size, 4), level, dtype=torch.uint8)
    image[..., 3] = alpha
    split = Split(cameras, [image] * 6, [str(view) for view in range(6)])
    bounds = torch.tensor([[0.0] * 3, [1.0] * 3])
    return Scene("stress", {"train": split, "test": split}, torch.ones(3), bounds, 1.0, "stress")


def _field(backend: str, device: str, precision: str) -> HashField:
    generator = torch.Generator().manual_seed(0)
    kind: FieldPrecision = "bf16" if precision == "bf16" else "fp32"
    return HashField(GRID, precision=kind, backend=backend, generator=generator).to(device)


def _training(scene: Scene, options: TrainingOptions, *where: str) -> FieldTraining:
    budget = Budget("stress", STEPS, samples=512)
    training = FieldTraining(_field(*where), scene, budget, options, seed=0)
    training.rays = MIN_RAYS
    return training


def _stays_finite(make: Callable[[], Scene], *where: str) -> float:
    training = _training(make(), QUICK, *where)
    losses = [loss for _ in range(STEPS) for loss in training.advance().values()]
    loop.check_finite(training)
    return 0.0 if all(map(math.isfinite, losses)) else math.inf


def _keeps_a_good_state(rate: float, *where: str) -> float:
    new = partial(_training, _scene(128), replace(QUICK, rate=rate), *where)
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
            loop.load(training, kept)
    loop.check_finite(training)
    return 0.0


def _reports(value: float, *where: str) -> float:
    training = _training(_scene(128), QUICK, *where)
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


def _rendered(field: HashField) -> Tensor:
    """Sum of all numbers of the pixels of 8 rays of 16 samples."""
    device, generator = field.device, torch.Generator().manual_seed(0)
    positions = torch.rand(128, 3, generator=generator).to(device)
    sigma, geometry = field.density(positions)
    directions = torch.ones(128, 3, device=device)
    values = field.features(geometry, field.encode_directions(directions))
    t = torch.linspace(1, 2, 16, device=device).repeat(8)
    offsets = torch.arange(0, 129, 16, device=device)
    intervals = Intervals(t, torch.full_like(t, 1 / 16), offsets)
    pixels = composite(sigma, values, intervals, backend=field.backend)
    return pixels.values.sum() + pixels.depth_sum.sum() + pixels.alpha.sum()


def _shrunk_gradient_error(*where: str) -> float:
    """Largest error of the gradients of all parameters, relative to the largest of each."""
    field = _field(*where)
    learned = list(field.parameters())
    whole = torch.autograd.grad(_rendered(field), learned)
    shrunk = torch.autograd.grad(1e-20 * _rendered(field), learned)
    return max(
        ((1e20 * s.double() - w.double()).abs().max() / w.abs().max()).item()
        for s, w in zip(shrunk, whole, strict=True)
    )


def _extreme_density(raw: float, *where: str) -> float:
    field = _field(*where)
    with torch.no_grad():
        field.table.fill_(1.0)
        field.layers["density_in"].fill_(1 / GRID.channels)
        field.layers["density_out"].fill_(raw / len(field.layers["density_in"]))
        field.repack()
    total = _rendered(field)
    gradients = torch.autograd.grad(total, list(field.parameters()))
    return 0.0 if all(x.isfinite().all() for x in (total, *gradients)) else math.inf


def _unforgotten(*where: str) -> float:
    """Cells that count as occupied after the field was infinitely dense, and then empty."""
    field = _field(*where)
    cells = torch.zeros(128, 128, 128, dtype=torch.bool, device=field.device)
    cells[0, 0, :4] = True
    grid, generator = DensityGrid(cells), torch.Generator(field.device).manual_seed(0)
    with torch.no_grad():
        field.table.fill_(1.0)
        field.layers["density_in"].fill_(1.0)
        for weight, updates in ((1e4, 1), (-1e4, FORGOTTEN_AFTER)):
            field.layers["density_out"].fill_(weight)
            field.repack()
            for _ in range(updates):
                grid.update(field, generator, 256)  # visits all four cells
    return float(grid.occupancy.cells.sum())
