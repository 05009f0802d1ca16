"""What all tests share: devices, a poisoned `torch.empty`, a quiet log, tiny scene, method, run."""

import math
import os
import re
import signal
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import wraps
from pathlib import Path

import hypothesis
import pytest

# Before torch starts its threads: tests are small, and other tests have the other cores.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor

from bench import neighbours
from bench.cameras import look_at
from bench.console import ConsoleLog
from bench.measure import Task, measure, train
from bench.metrics import declare_torchvision
from bench.results import Store
from bench.trajectories import from_split
from bench.types import Budget, Camera, Frame, Log, Probe, Scene, Split, composite
from bench.weights import BACKBONES
from sweeps.overrides import CONFIGS
from tests.pretended_gpu import PretendedGpu, pretended_gpu
from tests.web import Web

STEERBENCH_1 = instantiate(OmegaConf.load(CONFIGS / "protocol/steerbench-1.yaml"))
QUICK = replace(STEERBENCH_1, name="quick", lpips=())  # without weights, which a test may lack

hypothesis.settings.register_profile("repeatable", deadline=None, derandomize=True)
hypothesis.settings.register_profile("fuzz", max_examples=10_000, deadline=5000)  # ms; no hang
hypothesis.settings.load_profile("repeatable")

# A shell makes its background processes, and all that they start, ignore SIGINT.
signal.signal(signal.SIGINT, signal.default_int_handler)

# Set before anything imports Triton, which reads it once.
if not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the file first that takes longest: begun last, it would run alone in the end."""
    items.sort(key=lambda item: item.path.name != "test_end_to_end.py")


@pytest.fixture(params=["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"])
def device(request) -> str:
    """Every device of this machine in turn."""
    return request.param


@pytest.fixture
def gpu() -> Iterator[PretendedGpu]:
    """A GPU, pretended: `device="cuda"` is there. Skips on a machine that has one."""
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pretended_gpu() as gpu:
        yield gpu


@pytest.fixture
def web() -> Iterator[Web]:
    """A web server on the loopback address, with nothing on it."""
    with Web() as web:
        thread = threading.Thread(target=web.serve_forever, args=(0.01,))
        thread.start()
        yield web
        web.shutdown()
        thread.join()


EMPTY = ((torch, "empty"), (torch, "empty_like"), (Tensor, "new_empty"))


@pytest.fixture(scope="session", autouse=True)
def poisoned_empty() -> Iterator[None]:
    """Fill what `torch.empty` and its kin return with NaN: an output nobody wrote then shows."""
    with pytest.MonkeyPatch.context() as patch:
        for owner, name in EMPTY:
            patch.setattr(owner, name, _poisoning(getattr(owner, name)))
        yield


@pytest.fixture(scope="session", autouse=True)
def own_turns(tmp_path_factory) -> Iterator[None]:
    """Tests wait for no measurement on this machine, no measurement waits for them, and nothing is
    said about what runs beside them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbours, "NOTABLE_SHARE", math.inf)
        patch.setenv("STEERBENCH_LOCKS", str(tmp_path_factory.mktemp("locks")))
        yield


def _poisoning(allocate):
    @wraps(allocate)
    def allocate_poisoned(*args, **kwargs):
        tensor = allocate(*args, **kwargs)
        with torch.no_grad():
            return tensor.fill_(math.nan) if tensor.is_floating_point() else tensor

    return allocate_poisoned


@pytest.fixture
def quiet_log(tmp_path) -> Log:
    """A log that says nothing and keeps its stages under `tmp_path`."""
    return ConsoleLog(tmp_path / "outputs", quiet=True)


@pytest.fixture(scope="session")
def shared_data() -> Path | None:
    """The folder with weights and data sets, `$STEERBENCH_DATA` or `../shared`; None without."""
    root = Path(os.environ.get("STEERBENCH_DATA", Path(__file__).parents[2] / "shared"))
    return root if root.is_dir() else None


@pytest.fixture
def tiny_scene() -> Scene:
    """Four training and six test pictures of 40 x 32 noise with straight alpha, on white."""
    splits = {"train": _tiny_split(4, seed=1), "test": _tiny_split(6, seed=2)}
    bounds = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    return Scene("tiny", splits, torch.ones(3), bounds, unit_length=3.0, digest="0123456789abcdef")


@pytest.fixture
def moved_scene(tiny_scene) -> Scene:
    """The unit cube is [-1.5, 1.5]^3 of the data set."""
    return replace(tiny_scene, origin=torch.full((3,), -1.5))


def _tiny_split(count: int, seed: int) -> Split:
    generator = torch.Generator().manual_seed(seed)
    images = [
        torch.randint(256, (32, 40, 4), dtype=torch.uint8, generator=generator)
        for _ in range(count)
    ]
    return Split(
        [camera_on_orbit(i / count) for i in range(count)], images, [f"r_{i}" for i in range(count)]
    )


def camera_on_orbit(turn: float) -> Camera:
    """A camera 2 units from the middle of the unit cube, looking at it."""
    angle = 2 * math.pi * turn
    middle = torch.full((3,), 0.5)
    away = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    up = torch.tensor([0.0, 0.0, 1.0])
    c2w = look_at(middle - 2 * away, middle, up)
    return Camera(c2w, 60.0, 60.0, 20.0, 16.0, 40, 32)


class OffsetMethod:
    """Renders the ground truth of the camera plus `offset`; `calls` lists the calls it got."""

    name = "offset"
    train_s = 0.0
    memory = 0
    sees_scored = True

    def __init__(self, device: str, offset: float) -> None:
        self.calls: list[str] = []
        self._device, self._offset = device, offset

    def fit(self, scene: Scene, budget: Budget, log: Log) -> None:
        self.calls.append("fit")
        self.train_s = 12.5
        test = scene.splits["test"]
        self._known = [
            (name, camera, composite(image, scene.background))
            for name, camera, image in zip(test.names, test.cameras, test.images, strict=True)
        ]

    def reset(self) -> None:
        self.calls.append("reset")

    def render(self, camera: Camera, probe: Probe) -> Frame:
        name, _, picture = min(self._known, key=lambda known: _apart(known[1], camera))
        self.calls.append(name)
        with probe.stage("look-up"):
            rgb = picture.to(self._device)
            with probe.stage("add"):
                rgb = rgb + self._offset
        probe.count("pixels", done=rgb[..., 0].numel() // 4, dense=rgb[..., 0].numel())
        return Frame(rgb, torch.full_like(rgb[..., 0], math.inf), torch.zeros_like(rgb[..., 0]))

    def sizes(self) -> dict[str, int]:
        return {"offset": 4, "table": 100}

    def settings(self) -> dict[str, str]:
        by = {"device": self._device, "backend": "reference", "field_precision": "fp32"}
        return by | {"engine": "none", "precision": "none"}


def _apart(one: Camera, other: Camera) -> float:
    return (one.c2w - other.c2w).abs().sum().item()


@pytest.fixture
def offset_method(device) -> OffsetMethod:
    """A method with known figures: its pictures are 8 levels brighter than the ground truth."""
    return OffsetMethod(device, 8 / 255)


@pytest.fixture(scope="session")
def real_lpips_weights(shared_data) -> Path | None:
    """A folder with the backbones of LPIPS, if there is one on this machine."""
    real = os.environ.get("STEERBENCH_WEIGHTS") or (shared_data and shared_data / "lpips")
    return Path(real) if real and Path(real).is_dir() else None


@pytest.fixture(scope="session")
def lpips_weights(real_lpips_weights, tmp_path_factory) -> Path:
    """A folder with the backbones of LPIPS: the real ones where they are, else random ones."""
    if real_lpips_weights:
        return real_lpips_weights
    declare_torchvision()
    import lpips

    folder = tmp_path_factory.mktemp("weights")
    with warnings.catch_warnings():  # torchvision deprecates how lpips calls it
        warnings.simplefilter("ignore", UserWarning)
        for net, (_, file) in BACKBONES.items():
            state = lpips.LPIPS(net=net, pnet_rand=True, verbose=False).net.state_dict()
            names = {name: re.sub(r"^slice\d+", "features", name) for name in state}
            torch.save({names[name]: state[name] for name in state}, folder / file)
    return folder


@pytest.fixture
def store(tmp_path, offset_method, tiny_scene, quiet_log) -> Store:
    """A store with one run, key `stored_run`, six frames, three of them pictured."""
    budget = Budget("none", steps=1, samples=1)
    task = Task(tiny_scene, from_split(tiny_scene), QUICK, budget, seed=5)
    train([offset_method], task, quiet_log)
    (measurement,) = measure([offset_method], task, quiet_log)
    record = {
        **measurement.record,
        "command": "steerbench run method=offset",
        "missing": {"lpips_alex": "no weights were found"},
    }
    store = Store(tmp_path)
    store.save({"what": "offset"}, replace(measurement, record=record))
    return store


@pytest.fixture
def stored_run(store) -> str:
    """The key of the run in `store`."""
    return store.rows()["run"].iloc[0]
