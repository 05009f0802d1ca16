"""A scene that a field can learn in seconds, and a field that has learned nothing."""

import math
import os
from collections import Counter

import pytest
import torch
from torch import Tensor

from bench.cameras import cast, look_at
from bench.console import ConsoleLog
from bench.types import Camera, Log, NullProbe, Scene, Split
from methods.instant_ngp.field import HashField
from methods.instant_ngp.stage1 import TrainedField, train_field
from methods.kernels.encode import HashGrid
from methods.kernels.types import Occupancy
from tests.common import seeded
from tests.methods.trainings import TAUGHT, TEACHER

SIZE = 32

GRID = HashGrid(levels=4, features=2, log2_table=10, n_min=4, n_max=32)

Cloud = tuple[HashField, Occupancy]


def ball(camera: Camera) -> Tensor:
    """A ball of radius 0.3 in the middle of the cube, coloured by its normal: uint8 [H, W, 4]."""
    rays = cast(camera)
    towards = torch.nn.functional.normalize(rays.directions, dim=-1)
    offset = torch.full((3,), 0.5) - rays.origins
    along = (offset * towards).sum(dim=-1)
    inside = 0.3**2 - (offset - along[:, None] * towards).square().sum(dim=-1)
    surface = rays.origins + (along - inside.clamp(min=0).sqrt())[:, None] * towards
    colour = 255 * (0.5 + (surface - 0.5) / 0.6)
    opaque = torch.full((len(colour), 1), 255.0)
    picture = torch.where(inside[:, None] > 0, torch.cat((colour, opaque), dim=1), 0)
    return picture.view(camera.height, camera.width, 4).byte()


def look_at_the_middle(turn: float, lift: float) -> Camera:
    """A camera at a distance of 1.6 from the middle of the unit cube."""
    angle, out = 2 * math.pi * turn, math.cos(lift)
    away = torch.tensor([math.cos(angle) * out, math.sin(angle) * out, math.sin(lift)])
    c2w = look_at(0.5 + 1.6 * away, torch.full((3,), 0.5), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(c2w, 40.0, 40.0, SIZE / 2, SIZE / 2, SIZE, SIZE)


class Work(NullProbe):
    """What was counted in all frames, by name."""

    def __init__(self) -> None:
        self.done: Counter[str] = Counter()

    def count(self, name: str, done: int | Tensor, dense: int | None = None) -> None:
        self.done[name] += int(done)


@pytest.fixture(scope="session", params=["reference", "cpu"])
def backend(request) -> str:
    return request.param


@pytest.fixture(scope="session")
def ball_scene() -> Scene:
    """24 training and 3 test pictures of a coloured ball on white."""
    splits = {}
    for name, count, shift in (("train", 24, 0.0), ("test", 3, 0.017)):
        cameras = [
            look_at_the_middle(i / count + shift, 0.9 * math.sin(5.0 * i)) for i in range(count)
        ]
        names = [f"{name}/{i}" for i in range(count)]
        splits[name] = Split(cameras, [ball(camera) for camera in cameras], names)
    bounds = torch.tensor([[0.1, 0.1, 0.1], [0.9, 0.9, 0.9]])
    return Scene("ball", splits, torch.ones(3), bounds, unit_length=1.0, digest="ball")


@pytest.fixture(scope="session")
def shared_log(tmp_path_factory) -> Log:
    """One folder for all tests, of all processes: what one of them trained, the others find."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    return ConsoleLog(root / "trained", quiet=True)


@pytest.fixture(scope="module")
def teacher(ball_scene, shared_log) -> TrainedField:
    """A field that has learned the ball."""
    return train_field(TEACHER, ball_scene, TAUGHT, shared_log)


@pytest.fixture
def cloud(device) -> Cloud:
    """A random field, dense enough to stop rays, in a box of the cube."""
    field = HashField(GRID, precision="fp32", generator=seeded(0))
    with torch.no_grad():
        field.table.mul_(3e4)
    cells = torch.zeros(32, 32, 32, dtype=torch.bool, device=device)
    cells[8:20, 4:28, 10:22] = True
    return field.to(device), Occupancy(cells)
