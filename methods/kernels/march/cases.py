"""Cases of the ray march. All backends return the same samples to the last bit: tolerance 0."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import normalize

from methods.kernels.case import Case, Prepared
from methods.kernels.march import MAX_SAMPLES, Occupancy, march

STEP = math.sqrt(3) / MAX_SAMPLES


def cases() -> list[Case]:
    """Every kind of ray, grid, window, phase and limit; and rays around a hollow sphere, timed."""
    kinds: list[tuple[str, int, dict]] = [
        ("no ray", 0, {}),
        ("one ray", 1, {}),
        ("inside and outside", 129, {}),
        ("jitter", 129, {"jitter": True}),
        ("window", 129, {"window": True}),
        ("window without bounds", 129, {"unbounded": True}),
        ("resumed", 129, {"resumed": True}),
        ("limit 1", 129, {"limit": 1}),
        ("limit 7", 129, {"limit": 7}),
        ("empty grid", 65, {"grid": "empty"}),
        ("full grid", 65, {"grid": "full"}),
        ("one cell", 65, {"grid": "cell"}),
        ("scattered cells", 65, {"grid": "dust"}),
        ("axes, planes and corners", 0, {"special": True}),
    ]
    found = [
        Case("march", name, "fp32", count, partial(_prepare, count, options))
        for name, count, options in kinds
    ]
    timed = partial(_prepare, 1 << 13, {"grid": "shell"})
    return [*found, Case("march", "hollow sphere", "fp32", 1 << 13, timed, timed=True)]


def _grid(kind: str, device: str) -> Occupancy:
    size = 128 if kind == "shell" else 32
    axis = (torch.arange(size) + 0.5) / size - 0.5
    radius = (axis[:, None, None] ** 2 + axis[:, None] ** 2 + axis**2).sqrt()
    cells = {
        "empty": radius < 0,
        "full": radius >= 0,
        "cell": torch.zeros(size, size, size, dtype=torch.bool),
        "shell": (radius > 0.27) & (radius < 0.3),
        "dust": torch.rand(size, size, size, generator=torch.Generator().manual_seed(3)) < 0.02,
    }[kind]
    if kind == "cell":
        cells[size - 1, 0, size // 2] = True
    return Occupancy(cells.to(device))


def _rays(count: int) -> tuple[Tensor, Tensor]:
    """Rays towards the cube from a sphere around it, every fourth from inside."""
    generator = torch.Generator().manual_seed(count)
    outside = normalize(torch.randn(count, 3, generator=generator), dim=-1) * 1.5 + 0.5
    inside = torch.rand(count, 3, generator=generator)
    origins = torch.where(torch.arange(count)[:, None] % 4 == 3, inside, outside)
    return origins, torch.rand(count, 3, generator=generator) - origins


def _special_rays() -> tuple[Tensor, Tensor]:
    """Rays along axes, diagonals, grid planes, through corners, without direction, not finite."""
    directions = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3)  # [27, 3], one is 0
    targets = torch.tensor([[0.5, 0.5, 0.5], [0.0, 0.0, 0.0], [1.0, 1.0, 0.5], [0.25, 0.3, 0.75]])
    far = targets[:, None] - 2 * directions
    near = targets[:, None].expand_as(far)
    bad = torch.tensor([[torch.nan, 0.5, 0.5], [0.5, torch.inf, 0.5], [0.5, 0.5, -1e30]])
    origins = torch.cat((far.reshape(-1, 3), near.reshape(-1, 3), bad))
    ahead = directions.expand(4, 27, 3).reshape(-1, 3)
    return origins, torch.cat((ahead, ahead, torch.ones(3, 3)))


def _prepare(count: int, options: dict, device: str) -> Prepared:
    origins, directions = _special_rays() if options.get("special") else _rays(count)
    rays, generator = len(origins), torch.Generator().manual_seed(4)
    arguments: dict[str, Tensor | int] = {}
    if options.get("jitter"):
        arguments["jitter"] = torch.rand(rays, generator=generator).to(device)
    if options.get("window"):
        near = torch.rand(rays, generator=generator)
        arguments["window"] = torch.stack((near, near + 0.5), dim=1).to(device)
    if options.get("unbounded"):
        arguments["window"] = torch.tensor([-torch.inf, torch.inf]).expand(rays, 2).to(device)
    if options.get("resumed"):
        arguments["start"] = torch.randint(-1, 400, (rays,), generator=generator).int().to(device)
    if "limit" in options:
        arguments["limit"] = options["limit"]
    grid = _grid(options.get("grid", "dust"), device)
    origins, directions = origins.to(device), directions.to(device)

    def call(backend: str) -> tuple[Tensor, ...]:
        samples = march(origins, directions, grid, STEP, backend=backend, **arguments)  # type: ignore[arg-type]
        return (
            samples.offsets,
            samples.ray,
            samples.t,
            samples.delta,
            samples.positions,
            samples.resume,
        )

    return Prepared(call, 0.0)
