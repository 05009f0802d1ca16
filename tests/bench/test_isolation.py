"""What a method is given is its own, and what it leaves behind is put back."""

import gc
import os
import random
import signal
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import ImageFile

from bench.errors import SteerbenchError
from bench.isolation import Guard, Isolated, as_begun, fit, given, lent, moved, put_back
from bench.types import Budget
from tests.conftest import OffsetMethod, camera_on_orbit

BUDGET = Budget("tiny", steps=1, samples=1)


class Greedy(OffsetMethod):
    """Does `deed` with the scene that it is given."""

    sees_scored = False

    def __init__(self, deed) -> None:
        super().__init__("cpu", 0.0)
        self._deed = deed

    def fit(self, scene, budget, log) -> None:
        self._deed(scene)


def test_a_method_is_given_the_training_split_and_nothing_that_shows_the_truth(tiny_scene):
    scene = replace(tiny_scene, exact=lambda camera: None, surface=lambda camera: None)
    blind = given(scene, Greedy(None))
    assert list(blind.splits) == ["train"]
    assert blind.exact is blind.surface is None
    seeing = given(scene, OffsetMethod("cpu", 0.0))
    assert list(seeing.splits) == list(scene.splits)
    assert seeing.exact is scene.exact


def ways_to_spoil(scene):
    yield lambda s: s.splits["train"].cameras[0].c2w.mul_(-1)
    yield lambda s: s.splits["train"].cameras.clear()
    yield lambda s: s.splits["train"].names.clear()
    yield lambda s: s.background.fill_(0.5)
    yield lambda s: s.bounds.fill_(0.5)
    yield lambda s: s.origin.fill_(0.5)


def test_cameras_and_small_tensors_of_a_scene_cannot_be_spoilt(tiny_scene, quiet_log):
    train = tiny_scene.splits["train"]
    poses = [camera.c2w.clone() for camera in train.cameras]
    small = [x.clone() for x in (tiny_scene.background, tiny_scene.bounds, tiny_scene.origin)]
    for deed in ways_to_spoil(tiny_scene):
        fit(Greedy(deed), tiny_scene, BUDGET, 0, quiet_log)
    assert len(train.names) == len(poses)
    assert all(map(torch.equal, poses, (camera.c2w for camera in train.cameras)))
    now = (tiny_scene.background, tiny_scene.bounds, tiny_scene.origin)
    assert all(map(torch.equal, small, now))


@pytest.mark.parametrize(
    "deed",
    [
        lambda images: images[2].__setitem__((0, 0, 0), images[2][0, 0, 0] ^ 1),  # a single bit
        lambda images: images[0].numpy().fill(255),
        lambda images: images.__setitem__(1, images[0]),
        lambda images: images.pop(),
    ],
)
def test_a_method_that_changes_pictures_in_place_is_named(deed, tiny_scene, quiet_log):
    method, guard = (
        Greedy(lambda scene: deed(scene.splits["train"].images)),
        Guard(tiny_scene, quiet_log),
    )
    guard.check([method])
    with pytest.raises(SteerbenchError, match="offset changed pictures of tiny in place"):
        fit(method, tiny_scene, BUDGET, 0, quiet_log)
    with pytest.raises(SteerbenchError, match="offset changed pictures of tiny in place"):
        guard.check([method])


def test_a_lent_camera_is_written_to_alone_and_a_moved_one_sees_the_same_from_a_hair_away():
    camera = camera_on_orbit(0.3)
    before = camera.c2w.clone()
    lent(camera).c2w.fill_(0)
    away = moved(camera, hairs=2)
    assert torch.equal(camera.c2w, before)
    assert torch.equal(away.c2w[:, :3], before[:, :3])
    torch.testing.assert_close(
        away.c2w[:, 3] - before[:, 3], torch.full((3,), 2e-3), atol=1e-6, rtol=0
    )


def untidy(folder) -> None:
    torch.set_num_threads(torch.get_num_threads() + 1)
    torch.set_default_dtype(torch.float64)
    torch.set_default_device("meta")
    torch.set_grad_enabled(not torch.is_grad_enabled())
    torch.set_float32_matmul_precision("medium")
    torch.set_deterministic_debug_mode("warn")
    torch.backends.cudnn.benchmark = not torch.backends.cudnn.benchmark
    torch.set_autocast_enabled("cpu", True)
    torch.backends.mkldnn.enabled = False
    ImageFile.LOAD_TRUNCATED_IMAGES = True
    gc.disable()
    sys.setswitchinterval(1.0)
    np.seterr(all="raise")
    os.chdir(folder)
    os.environ["LEFT_BEHIND"] = "1"
    sys.argv.append("left behind")
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])


def test_global_state_is_put_back_and_each_part_of_it_told(tmp_path):
    def seen():
        device = torch.get_default_device()
        of_torch = torch.get_num_threads(), torch.get_default_dtype(), torch.is_grad_enabled()
        of_system = os.getcwd(), os.sched_getaffinity(0), signal.getsignal(signal.SIGUSR1)  # noqa: PTH109
        of_python = dict(os.environ), list(sys.argv), list(warnings.filters)
        of_libraries = np.geterr(), torch.backends.cudnn.benchmark, gc.isenabled()
        of_libraries += torch.is_autocast_enabled("cpu"), ImageFile.LOAD_TRUNCATED_IMAGES
        of_libraries += torch.backends.mkldnn.enabled, sys.getswitchinterval()
        return device, *of_torch, *of_system, *of_python, *of_libraries

    before, told = seen(), []
    with put_back(told.append):
        untidy(tmp_path)
    assert seen() == before
    several_cores = len(os.sched_getaffinity(0)) > 1
    assert len(told) == 18 + several_cores
    told.clear()
    with put_back(told.append):
        pass
    assert told == []


def test_what_was_set_before_changes_no_figure():
    """As a plug-in does when it is imported."""
    with put_back():
        torch.set_float32_matmul_precision("medium")
        torch.set_autocast_enabled("cpu", True)
        ImageFile.LOAD_TRUNCATED_IMAGES = True
        with as_begun():
            assert torch.get_float32_matmul_precision() == "highest"
            assert not torch.is_autocast_enabled("cpu")
            assert not ImageFile.LOAD_TRUNCATED_IMAGES
        assert torch.is_autocast_enabled("cpu")


def test_a_shared_function_that_was_replaced_is_named_before_anything_is_computed(monkeypatch):
    monkeypatch.setattr(torch.nn.functional, "softplus", lambda x: x)
    said = r"test_isolation has replaced torch.nn.functional.softplus, which others compute with"
    with pytest.raises(SteerbenchError, match=said), as_begun():
        pass
    monkeypatch.undo()
    with as_begun():
        pass


def fail_untidily() -> None:
    with put_back():
        torch.set_default_dtype(torch.float64)
        raise KeyError


def test_global_state_is_put_back_also_after_an_error():
    with pytest.raises(KeyError):
        fail_untidily()
    assert torch.get_default_dtype() == torch.float32


def numbers() -> list[float]:
    return [torch.rand(()).item(), np.random.random(), random.random()]


def test_random_numbers_of_a_method_are_its_own_and_go_on_from_call_to_call(quiet_log):
    method = OffsetMethod("cpu", 0.0)
    outside = torch.get_rng_state(), random.getstate()
    one, other = Isolated(method, 3, quiet_log), Isolated(method, 3, quiet_log)
    drawn: dict[Isolated, list] = {one: [], other: []}
    for who in (one, one, other, one, other, other):
        with who.call():
            drawn[who] += numbers()
    assert drawn[one] == drawn[other]
    assert len(set(drawn[one])) == 9
    assert torch.equal(outside[0], torch.get_rng_state())
    assert outside[1] == random.getstate()


def test_what_a_method_changed_is_said_once(log):
    isolated = Isolated(OffsetMethod("cpu", 0.0), 0, log)
    for _ in range(2):
        with isolated.call():
            torch.set_default_dtype(torch.float64)
    assert log.messages == ["offset changed torch's default type, which was put back"]
