"""Every method on a pretended GPU: it trains and renders there, with the numbers of the CPU."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch

from bench.cameras import scale_camera
from bench.case import Difference
from bench.console import ConsoleLog
from bench.measure import Task, measure, train
from bench.trajectories import from_split
from bench.types import Budget, Method, NullProbe, Scene, Split
from bench.waits import device_waits
from methods.checks import found
from methods.engines import torch_engine
from methods.engines.torch_engine import TorchEngine
from methods.instant_ngp.field import HashField
from methods.instant_ngp.stage1 import Setup
from methods.instant_ngp.training import FieldTraining
from methods.kernels import availability, multiplies_bf16
from methods.kernels.encode import HashGrid
from methods.kernels.march import longest_ray
from methods.kilonerf.field import KiloField
from methods.nerf.field import NerfField
from methods.nsvf.field import NsvfField
from methods.rendering import field, frame
from methods.rendering.occupancy import EVERY, STEP
from methods.steernerf.method import SteerNerf
from methods.steernerf.options import RangeReduction
from methods.steernerf.pipeline import Pipeline
from methods.steernerf.stage2 import JointTraining
from methods.steernerf.unet import UNet
from methods.students.fields import StudentField
from methods.training import loop
from tests.common import seeded
from tests.conftest import EMPTY, QUICK
from tests.methods.models import small_joint, small_model, small_motion, small_rendering
from tests.methods.small_students import extraction
from tests.methods.trainings import killed
from tests.methods.usual import field_options, lessons, new_gaussians, new_ngp, usual
from tests.pretended_gpu import pretended_gpu

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
needs_triton = pytest.mark.skipif(
    bool(availability()["gpu"]), reason="Triton has no build for this platform"
)

BUDGET = Budget("test", steps=4, samples=512, renderer_steps=2)
GRID = HashGrid(levels=4, features=2, log2_table=10, n_min=4, n_max=32)
STAGE1 = field_options(march_step=8.0, grid_samples=4096, max_rays=64)
MOTION = small_motion(pool=1, uses=3)
FEW: dict[str, Any] = {"batch": 1, "patch": 4, "distilled_views": 1, "motion": MOTION}


def steernerf(field: str, **others: Any) -> Method:
    """The paper's, with its range reduction."""
    given = {
        "grid": GRID,
        "training": STAGE1,
        "model": small_model(),
        "rendering": small_rendering(range=RangeReduction("paper", 0.03, "sum")),
        "renderer": partial(UNet, width=4, aligned=True),
        "joint": small_joint(field=field, jitter=True, grid_samples=512, **FEW),
        "engine": TorchEngine(),
        **{"name": "steernerf", "precision": "bf16", "seed": 0, "steps": None},
    }
    return SteerNerf(**given | others)


def student(
    name: str, device: str, backend: str, lesson: Mapping[str, Any], **options: Any
) -> Method:
    grid = replace(GRID, levels=16)
    teacher = Setup.resolved(grid, STAGE1, "fp32", backend, device, seed=0)
    training = lessons(name, **lesson)
    return usual(f"method/{name}", teacher=teacher, training=training, **options)


SPARSE = extraction(rays=200, points=1, directions=4)
METHODS: Mapping[str, Callable[..., Method]] = {
    "ngp": partial(new_ngp, grid=GRID, training=STAGE1),
    "steernerf": partial(steernerf, "joint"),
    "steernerf, frozen": partial(steernerf, "frozen"),
    "gaussians": partial(new_gaussians, grid=GRID, training=STAGE1, count=40),
    "plenoctree": partial(student, "plenoctree", lesson={"samples": 512}, extraction=SPARSE),
    "diver": partial(student, "diver", lesson={"prune_rays": 256}, resolution=32),
    "kilonerf": partial(student, "kilonerf", lesson={"points_each": 8, "max_rays": 64}, networks=2),
    "nsvf": partial(student, "nsvf", lesson={"max_rays": 64}, resolution=32),
    "nerf": partial(student, "nerf", lesson={"max_rays": 64}),
}


def fitted(name: str, device: str, scene: Scene, folder: Path) -> Method:
    """On a GPU with the usual backend, which is the reference there."""
    backend = "auto" if device == "cuda" else "reference"
    method = METHODS[name](device=device, backend=backend)
    method.fit(scene, BUDGET, ConsoleLog(folder / device, quiet=True))
    return method


def frames(method: Method, scene: Scene) -> list[torch.Tensor]:
    """What two frames in sequence show, brought to the CPU."""
    method.reset()
    found = [method.render(camera, NullProbe()) for camera in scene.splits["test"].cameras]
    return [part.cpu() for x in found for part in (x.rgb, x.depth, x.alpha)]


def here_and_there(compute: Callable[[str], Any]) -> tuple[Any, Any]:
    """What `compute` returns for the CPU, and for the pretended GPU."""
    here = compute("cpu")
    with pretended_gpu():
        return here, compute("cuda")


assert_equal = partial(torch.testing.assert_close, rtol=0, atol=0)
assert_alike = partial(torch.testing.assert_close, rtol=0, atol=1e-6)
"""But for a few roundings of values up to 1. On a CPU with AVX-512 colours differed in the last
bit; which operation rounds in another way is not known."""


def fewer(split: Split, count: int, side: int = 16) -> Split:
    """The first `count` pictures, with `side` x `side` of their pixels."""
    every = split.cameras[0].width // side
    cameras = [scale_camera(camera, side, side) for camera in split.cameras[:count]]
    pictures = [picture[::every, ::every] for picture in split.images[:count]]
    return Split(cameras, pictures, split.names[:count])


@pytest.fixture(scope="module")
def scene(ball_scene) -> Scene:
    """A few small pictures of the ball, of which the middle is learned: few cells."""
    splits = {"train": fewer(ball_scene.splits["train"], 4)}
    splits["test"] = fewer(ball_scene.splits["test"], 2)
    bounds = torch.tensor([[0.3, 0.3, 0.3], [0.7, 0.7, 0.7]])
    return replace(ball_scene, splits=splits, bounds=bounds)


@pytest.fixture(autouse=True)
def one_round(monkeypatch) -> None:
    """Of whole rays, as on a GPU, also where they are hidden in training, so that the sums have the
    same groups; and as few runs of a network before it is recorded."""
    for kind in (HashField, StudentField, KiloField, NerfField, NsvfField):
        monkeypatch.setattr(kind, "round_samples", longest_ray(STEP))
    monkeypatch.setattr(frame, "GPU_SAMPLES", longest_ray(STEP))
    monkeypatch.setattr(torch_engine, "WARM_UP", 1)


@pytest.mark.parametrize("name", METHODS)
def test_it_trains_and_renders_as_on_the_cpu(name, scene, tmp_path):
    drawn = here_and_there(lambda device: frames(fitted(name, device, scene, tmp_path), scene))
    assert_alike(*drawn)


@pytest.fixture
def products_of_bfloat16(monkeypatch) -> Iterator[None]:
    """As real GPUs have."""
    capabilities = {**torch.cpu.get_capabilities(), "avx512_bf16": True}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    multiplies_bf16.cache_clear()
    yield
    multiplies_bf16.cache_clear()


@pytest.mark.usefixtures("products_of_bfloat16")
def test_with_products_of_bfloat16_it_trains_and_renders_as_on_the_cpu(scene, tmp_path):
    def drawn(device):
        assert multiplies_bf16(device)
        return frames(fitted("steernerf", device, scene, tmp_path), scene)

    assert_alike(*here_and_there(drawn))


def test_its_rows_are_those_of_the_cpu(scene, tmp_path):
    def rows(device):
        """All but times and peak memory."""
        method = METHODS["ngp"](device=device, backend="reference")
        protocol = replace(QUICK, warmup=0)
        task = Task(scene, from_split(scene), protocol, BUDGET, seed=0)
        log = ConsoleLog(tmp_path / device, quiet=True)
        train([method], task, log)
        found = measure([method], task, log)[0].rows
        timed = found["metric"].str.startswith(("frame_ms", "fps", "stage_ms", "train_", "peak"))
        assert timed.any()
        return found[~timed]

    here, there = here_and_there(rows)
    assert [name for name in here if not here[name].equals(there[name])] == ["device"]
    assert set(there["device"]) == {"cuda"}


def test_killed_in_stage_2_it_goes_on_as_if_it_had_not_been(gpu, scene, tmp_path):
    whole = frames(fitted("steernerf", "cuda", scene, tmp_path / "whole"), scene)
    with killed(JointTraining, 1):
        fitted("steernerf", "cuda", scene, tmp_path / "killed")
    assert list((tmp_path / "killed").glob("cuda/stages/steernerf-*/checkpoint.safetensors"))
    assert_equal(whole, frames(fitted("steernerf", "cuda", scene, tmp_path / "killed"), scene))


@pytest.mark.parametrize("places", [("cuda", "cpu"), ("cpu", "cuda")])
def test_what_was_trained_at_one_place_goes_on_at_the_other(gpu, places, scene, tmp_path):
    def training(device):
        field = HashField(GRID, backend="reference", generator=seeded(0)).to(device)
        return FieldTraining(field, scene, BUDGET, STAGE1, seed=0)

    first, second = map(training, places)
    first.advance()
    loop.save(first, tmp_path / "half")
    loop.load(second, tmp_path / "half")
    for one in (first, second):
        one.advance()
    assert second.field.device.type == places[1]
    results = ({name: x.cpu() for name, x in one.result().items()} for one in (first, second))
    assert_equal(*results)


@pytest.mark.parametrize("name", ["ngp", "nsvf", "steernerf"])
def test_a_frame_waits_for_its_rays_and_once_a_round_of_samples(
    gpu, name, scene, tmp_path, monkeypatch
):
    method = fitted(name, "cuda", scene, tmp_path)
    monkeypatch.setattr(frame, "GPU_SAMPLES", 1)
    march = Mock(wraps=frame.march)
    monkeypatch.setattr(frame, "march", march)
    cameras = [scale_camera(c, 32, 32) for c in scene.splits["test"].cameras]
    for camera in [cameras[0], *cameras]:  # the last ones have all preceding frames
        march.reset_mock()
        with device_waits() as waits:
            method.render(camera, NullProbe())
        assert waits.total() <= 2 + march.call_count <= 12


def test_a_step_of_stage_1_waits_less_than_three_times(gpu, scene):
    field = HashField(GRID, backend="reference").to("cuda")
    training = FieldTraining(field, scene, BUDGET, STAGE1, seed=0)
    training.advance()
    with device_waits() as waits:
        for _ in range(2 * EVERY):
            training.advance()
    assert waits.total() < 3 * 2 * EVERY


def test_a_step_of_stage_2_waits_a_few_times(gpu, scene, tmp_path, monkeypatch):
    """For the rays, their samples, the visible ones and the errors."""
    advance, counts = JointTraining.advance, []

    def counted(training):
        with device_waits() as waits:
            errors = advance(training)
        counts.append(waits.total())
        assert bool(errors) == (training.step > 1)  # those of the step before
        return errors

    def apart(remember, *args):
        with device_waits():
            remember(*args)

    monkeypatch.setattr(loop, "LOOK_EVERY", 1)
    monkeypatch.setattr(JointTraining, "advance", counted)
    remember = Pipeline.remember
    monkeypatch.setattr(Pipeline, "remember", lambda *args: apart(remember, *args))
    method = METHODS["steernerf"](device="cuda", backend="reference")
    method.fit(scene, replace(BUDGET, renderer_steps=4), ConsoleLog(tmp_path, quiet=True))
    assert len(counts) == 4
    assert sum(counts) <= 4 * len(counts)


def smallest(name: str, **where: Any) -> Method:
    """A method as small as it gets: an interpreter takes long for a step of a ray."""
    few = {
        "grid": replace(GRID, levels=2),
        "training": field_options(march_step=64.0, grid_samples=16, max_rays=64),
    }
    if name == "ngp":
        return new_ngp(**few, **where)
    if name == "gaussians":
        return new_gaussians(**few, count=4, **where)
    less = FEW | {"distilled_views": 0}
    lessons = small_joint(field="joint", **less)
    return steernerf("joint", model=small_model(step=64.0, frames=1), joint=lessons, **few, **where)


@pytest.fixture
def tiny(ball_scene) -> Scene:
    splits = {name: fewer(split, 3, side=8) for name, split in ball_scene.splits.items()}
    return replace(ball_scene, splits=splits)


@pytest.mark.slow
@needs_triton
@pytest.mark.parametrize("name", ["ngp", "steernerf", "gaussians"])
def test_by_triton_it_trains_and_renders_as_on_the_cpu(name, tiny, tmp_path, monkeypatch):
    from triton.runtime.interpreter import interpreter_builder as builder

    # What takes half of the time, and is looked for by the tests of the kernels.
    monkeypatch.setattr(builder, "options", replace(builder.options, sanitize_overflow=False))
    monkeypatch.setattr(field, "BATCH_QUANTUM", 64)
    budget = replace(BUDGET, steps=1, samples=64, renderer_steps=1)

    def drawn(device):
        method = smallest(name, device=device, backend="gpu")
        method.fit(tiny, budget, ConsoleLog(tmp_path / device, quiet=True))
        return frames(method, tiny)

    here, there = here_and_there(drawn)
    assert here[0].std() > 0
    assert_alike(here, there)  # only a CPU pads what it multiplies


@pytest.mark.slow
@needs_triton
@pytest.mark.usefixtures("products_of_bfloat16")
def test_steps_and_frames_are_few_launches(gpu, tiny, tmp_path, monkeypatch):
    """Each takes some microseconds, whatever it computes."""
    steps = []
    advance, march = FieldTraining.advance, Mock(wraps=frame.march)

    def advanced(training):
        before = gpu.launched
        errors = advance(training)
        steps.append(gpu.launched - before)
        return errors

    for owner, name in EMPTY:  # without the launches that poison it
        monkeypatch.setattr(owner, name, getattr(owner, name).__wrapped__)
    monkeypatch.setattr(FieldTraining, "advance", advanced)
    monkeypatch.setattr(frame, "march", march)
    method = smallest("ngp", device="cuda", backend="gpu")
    method.fit(tiny, replace(BUDGET, samples=64), ConsoleLog(tmp_path, True))
    assert max(steps[1:]) <= 200  # the first updates the density grid
    frames(method, tiny)  # what later ones need is made once
    for samples in longest_ray(STEP), 1:
        monkeypatch.setattr(frame, "GPU_SAMPLES", samples)
        march.reset_mock()
        before = gpu.launched
        method.render(tiny.splits["test"].cameras[0], NullProbe())
        assert gpu.launched - before <= 87 + 37 * march.call_count
    assert march.call_count > 1


GO_ON = [
    ("adam", "30% of 70, 3 features"),
    ("composite backward", "one sample a ray"),
    ("encode backward", "one sample"),
    ("hash adam", "1 samples, 2 features"),
]
"""Cases of kernels for which the host does not wait."""

WAIT = [("march", "limit 1")]


@needs_triton
@pytest.mark.parametrize("which", [*GO_ON, *WAIT], ids=" ".join)
def test_a_case_of_a_kernel_of_triton_is_computed_there_as_on_the_cpu(
    which,
):
    """And while it is computed, the host goes on."""
    case = next(case for case in found("cases") if (case.subject, case.name) == which)
    assert isinstance(case.error, Difference)
    here = case.error.prepare("cpu")("gpu")
    with pretended_gpu():
        compute = case.error.prepare("cuda")
        there = [x.cpu() for x in compute("gpu")]  # what never changes is copied once
        if which in GO_ON:
            torch.cuda.set_sync_debug_mode("error")
            compute("gpu")
    assert_equal(list(here), there)
