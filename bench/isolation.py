"""What a method is given, and what it may leave behind: nothing that others are measured on.

A method runs in the process that measures it, with others before and after it. It gets copies of
cameras, and the training pictures alone unless it asks for more. The global state of Python and
torch is put back after each call; the method has random numbers of its own.
"""

from __future__ import annotations

import gc
import os
import random
import signal
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import ImageFile

from bench.kinds import Say
from bench.provenance import is_edited
from bench.threads import in_parallel
from bench.types import Budget, Camera, Log, Method, Scene, SteerbenchError

TRAINING = "train"
"""The split that every method learns from."""

HAIR = 1e-3
"""Scene units by which a camera is moved so that no frame that was kept is that of its pose."""


def lent(camera: Camera) -> Camera:
    """`camera` with a pose of its own, which may be written to."""
    return replace(camera, c2w=camera.c2w.clone())


def moved(camera: Camera, hairs: int) -> Camera:
    """`camera`, so many `HAIR`s away along each axis: it sees the same, at the same cost."""
    pose = camera.c2w.clone()
    pose[:, 3] += hairs * HAIR
    return replace(camera, c2w=pose)


def sees_scored(method: Method) -> bool:
    """Whether the method asks for all splits and for the exact pictures, not only for training
    pictures: its attribute `sees_scored`."""
    return bool(getattr(method, "sees_scored", False))


def given(scene: Scene, method: Method) -> Scene:
    """The part of `scene` that `method` is given to learn from, with small tensors of its own.

    Pictures and masks are shared, because they are large: see `Guard`.
    """
    all_of_it = sees_scored(method)
    splits = {}
    for name, split in scene.splits.items():
        if all_of_it or name == TRAINING:
            cameras = [lent(camera) for camera in split.cameras]
            splits[name] = replace(split, cameras=cameras, names=list(split.names))
    return replace(
        scene,
        splits=splits,
        background=scene.background.clone(),
        bounds=scene.bounds.clone(),
        origin=scene.origin.clone(),
        maps={name: matrix.clone() for name, matrix in scene.maps.items()},
        exact=scene.exact if all_of_it else None,
        surface=scene.surface if all_of_it else None,
    )


class Guard:
    """Finds out whether pictures or masks of a scene were written to, by their checksums. It reads
    all of them when it is made, so that damaged files raise there."""

    def __init__(self, scene: Scene, log: Log) -> None:
        self._scene, self._log = scene, log
        self._sums = self._summed()

    def check(self, methods: Sequence[Method]) -> None:
        """Raise SteerbenchError, with the names of the methods that had the pictures, if one was
        changed: all that is measured on this scene from here on would be wrong."""
        if self._summed() != self._sums:
            names = " or ".join(method.name for method in methods)
            raise SteerbenchError(
                f"{names} changed pictures of {self._scene.name} in place, on which others are "
                "trained and scored: expected a method that works on copies (image.clone())"
            )

    def _summed(self) -> list[int]:
        tensors: list[torch.Tensor] = []
        for split in self._scene.splits.values():
            tensors += split.images
            tensors += (mask for mask in split.masks if mask is not None)
        return in_parallel(_checksum, tensors, "check pictures", self._log)


def _checksum(tensor: torch.Tensor) -> int:
    return zlib.crc32(tensor.contiguous().numpy().data)


SIGNALS = signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM, signal.SIGUSR1
"""Those that programs handle; to look up the handlers of all takes longer than a small frame."""

FEW, NOTABLE_S = 0.2, 2.0
"""A method counts too little as training that tells less than this share of so many seconds."""

AUTOCAST = "cpu", "cuda"
"""The types of device that torch casts for."""

SHARED = (torch, torch.nn.functional, torch.Tensor, np, np.random)
ORIGINALS = {
    (owner, name): value
    for owner in SHARED
    for name, value in vars(owner).items()
    if callable(value)
}
"""Functions that all methods compute with, as they were when this process began."""

CUDNN = "enabled", "benchmark", "deterministic", "allow_tf32"
"""Options of `torch.backends.cudnn`."""

OF_IMPORTS = ("the environment", "filters of warnings")
"""Parts that libraries change when they are first imported; no line is said of these."""


def _state() -> dict[str, Any]:
    """The global state that is put back, but for random numbers, by what it is called."""
    device = torch.get_default_device()
    return {
        "torch's number of threads": torch.get_num_threads(),
        "torch's default type": torch.get_default_dtype(),
        "torch's default device": None if device.type == "cpu" else device,  # None costs nothing
        "torch's recording of gradients": torch.is_grad_enabled(),
        "torch's precision of products": torch.get_float32_matmul_precision(),
        "torch's deterministic mode": torch.get_deterministic_debug_mode(),
        "torch's autocast": [torch.is_autocast_enabled(kind) for kind in AUTOCAST],
        "torch's use of oneDNN": torch.backends.mkldnn.enabled,
        "cuDNN's options": [getattr(torch.backends.cudnn, name) for name in CUDNN],
        "numpy's handling of errors": np.geterr(),
        "the flushing of denormal numbers": sys.float_info.min / 2 == 0.0,
        "Pillow's reading of truncated files": ImageFile.LOAD_TRUNCATED_IMAGES,
        "collection of garbage": gc.isenabled(),
        "the interval of switching threads": sys.getswitchinterval(),
        "the working folder": _folder(),
        "the environment": dict(os.environ),
        "sys.argv": list(sys.argv),
        "handlers of signals": [signal.getsignal(number) for number in SIGNALS],
        "filters of warnings": (list(warnings.filters), warnings.showwarning),
        "the cores of this process": os.sched_getaffinity(0),
    }


def _folder() -> str:
    """The working folder; empty if it was removed."""
    try:
        return str(Path.cwd())
    except FileNotFoundError:
        return ""


def _set_environment(variables: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(variables)


def _set_words(words: list[str]) -> None:
    sys.argv[:] = words


def _set_handlers(handlers: list[Any]) -> None:
    for number, handler in zip(SIGNALS, handlers, strict=True):
        if handler is not None:  # None: it is not Python's
            signal.signal(number, handler)


def _set_warnings(state: tuple[list[Any], Any]) -> None:
    warnings.resetwarnings()  # which also makes Python forget what it knew of the filters
    warnings.filters[:], warnings.showwarning = state  # type: ignore[index]


def _set_autocast(kinds: list[bool]) -> None:
    for kind, enabled in zip(AUTOCAST, kinds, strict=True):
        torch.set_autocast_enabled(kind, enabled)


def _set_collection(enabled: bool) -> None:
    (gc.enable if enabled else gc.disable)()


def _set_cudnn(values: list[Any]) -> None:
    for name, value in zip(CUDNN, values, strict=True):
        setattr(torch.backends.cudnn, name, value)


SETTERS: Mapping[str, Callable[[Any], object]] = {
    "torch's number of threads": torch.set_num_threads,
    "torch's default type": torch.set_default_dtype,
    "torch's default device": torch.set_default_device,
    "torch's recording of gradients": torch.set_grad_enabled,
    "torch's precision of products": torch.set_float32_matmul_precision,
    "torch's deterministic mode": torch.set_deterministic_debug_mode,
    "torch's autocast": _set_autocast,
    "torch's use of oneDNN": partial(setattr, torch.backends.mkldnn, "enabled"),
    "Pillow's reading of truncated files": partial(setattr, ImageFile, "LOAD_TRUNCATED_IMAGES"),
    "collection of garbage": _set_collection,
    "the interval of switching threads": sys.setswitchinterval,
    "cuDNN's options": _set_cudnn,
    "numpy's handling of errors": lambda errors: np.seterr(**errors),
    "the flushing of denormal numbers": torch.set_flush_denormal,
    "the working folder": os.chdir,
    "the environment": _set_environment,
    "sys.argv": _set_words,
    "handlers of signals": _set_handlers,
    "filters of warnings": _set_warnings,
    "the cores of this process": partial(os.sched_setaffinity, 0),
}
"""What sets each part of `_state` again."""

USUAL: Mapping[str, object] = {
    "torch's default type": torch.float32,
    "torch's default device": None,
    "torch's recording of gradients": True,
    "torch's precision of products": "highest",
    "torch's deterministic mode": "default",
    "torch's autocast": [False, False],
    "torch's use of oneDNN": True,
    "Pillow's reading of truncated files": False,
    "the flushing of denormal numbers": False,
}
"""What changes figures and is in no key, as it is in a process that has just begun."""


def _drawn() -> tuple[Any, ...]:
    """The state of all global random numbers."""
    gpus = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
    return torch.get_rng_state(), np.random.get_state(), random.getstate(), gpus


def _draw_from(drawn: tuple[Any, ...]) -> None:
    torch.set_rng_state(drawn[0])
    np.random.set_state(drawn[1])
    random.setstate(drawn[2])
    if drawn[3]:
        torch.cuda.set_rng_state_all(drawn[3])


@contextmanager
def put_back(tell: Say = lambda part: None) -> Iterator[None]:
    """Put the global state of this process back as it was when the body ends; `tell` gets each part
    but random numbers that the body changed."""
    before = _state()
    drawn = _drawn()
    try:
        yield
    finally:
        _draw_from(drawn)
        now = _state()
        for part, put in SETTERS.items():
            if now[part] != before[part]:
                put(before[part])
                tell(part)


def check_originals() -> None:
    """Raise SteerbenchError if somebody's own code replaced a function that all methods share: the
    figures of others would be of it, too, and no key would say so."""
    for (owner, name), original in ORIGINALS.items():
        now = vars(owner).get(name)
        if now is original:
            continue
        by = str(getattr(now, "__module__", None))
        if by == "__main__" or is_edited(getattr(sys.modules.get(by), "__file__", None)):
            raise SteerbenchError(
                f"{by} has replaced {owner.__name__}.{name}, which others compute "
                "with, too: leave it as it is, or measure the method in a process of its own "
                "(method=external)"
            )


@contextmanager
def as_begun() -> Iterator[None]:
    """Compute as in a process that has just begun, whatever its user has set, and put all back;
    raises as `check_originals` does."""
    check_originals()
    with put_back():
        for part, value in USUAL.items():
            SETTERS[part](value)
        yield


class Isolated:
    """The calls of one method: what they leave of the global state is put back, and said once.

    Their random numbers are a sequence of their own, which begins at `seed`: those of a method do
    not depend on what is measured beside it.
    """

    def __init__(self, method: Method, seed: int, log: Log) -> None:
        self._method, self._seed, self._log = method, seed, log
        self._random: tuple[Any, ...] | None = None
        self._told: set[str] = set()

    @contextmanager
    def call(self) -> Iterator[None]:
        with put_back(self._tell):
            self._continue()
            yield
            self._random = _drawn()

    def _continue(self) -> None:
        """Go on with the method's own random numbers, or begin them."""
        if self._random is not None:
            _draw_from(self._random)
            return
        torch.manual_seed(self._seed)
        np.random.seed(self._seed % 2**32)
        random.seed(self._seed)

    def _tell(self, part: str) -> None:
        if part not in self._told and part not in OF_IMPORTS:
            self._told.add(part)
            self._log.info(f"{self._method.name} changed {part}, which was put back")


def fit(
    method: Method, scene: Scene, budget: Budget, seed: int, log: Log, guard: Guard | None = None
) -> None:
    """Let `method` learn from what it is given of `scene`: every training passes here.

    `guard` watches pictures of `scene`, by default those that the method is given. Raises
    SteerbenchError if the method changed one: the scene is then of no use to others.
    """
    part = given(scene, method)
    guard = guard or Guard(part, log)
    begun = time.monotonic()
    with Isolated(method, seed, log).call():
        method.fit(part, budget, log)
    passed = time.monotonic() - begun
    if passed > NOTABLE_S and method.train_s < FEW * passed:
        log.info(f"{method.name}: `fit` took {passed:.0f} s, its train_s says {method.train_s:.3g}")
    check_originals()
    guard.check([method])
