"""`steerbench kernels --worth`: what the fast version of each kernel brings to each method.

A method is trained for a moment. Then it renders the same frames, and trains as briefly again, in
turns: with all kernels as they are, and with one of them computed by its reference.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from statistics import median
from typing import Any

import torch
from omegaconf import DictConfig

from bench.accuracy import render_in_turns
from bench.console import ConsoleLog
from bench.types import Camera, Frame, Method, NullProbe, Probe, Scene
from reports.tables import Table, decimal
from sweeps.build import build
from sweeps.configured import checked_settings
from sweeps.device_lock import device_lock
from sweeps.overrides import choices, composed, swept
from sweeps.terminal import print_rows, show
from sweeps.variants import Row, common_ground

SETTINGS = ("scene=totem", "scene.width=100", "trajectory=orbit", "budget=tiny")

COLUMNS = (
    *("method", "kernel", "frame, ms", "by its reference", "ratio"),
    *("training, s", "by its reference", "ratio", "brings"),
)
"""`brings`: the share that the fast version saves of a frame or of a training, the larger one."""

AS_IT_IS = ""
"""In place of the name of a kernel: none is computed by its reference."""


def worth(words: Sequence[str], frames: int, repeats: int) -> int:
    """Print a table, then its rows as JSON in the last line.

    Args:
        words: settings as of `steerbench run`; without `method=a,b`, all methods are measured.
        frames: first frames of the trajectory.
        repeats: timed rounds over these frames, and timed trainings.
    """
    typed = [word.partition("=")[2] for word in words if word.startswith("method=")]
    names = swept(words).get("method", typed) or list(choices("method", words))
    rest = [*SETTINGS, *(word for word in words if not word.startswith("method="))]
    rows = [row for name in names for row in _rows(name, rest, frames, repeats)]
    show(Table("What the fast version of a kernel brings", COLUMNS, tuple(map(_line, rows))))
    print_rows(rows)
    return 0


def _rows(name: str, words: Sequence[str], frames: int, repeats: int) -> list[Row]:
    """A row for each kernel that the method calls."""
    from methods.kernels.dispatch import kernel_calls

    config = composed([*words, f"method={name}"])
    settings = checked_settings(config)
    log = ConsoleLog(Path(settings.outputs))
    scene, path, protocol = common_ground(config, frames)
    with device_lock(settings.device, log):
        with kernel_calls() as in_training:
            method, _ = _trained(config, scene, AS_IT_IS)
        with kernel_calls() as in_frames, torch.no_grad():
            for step in path.steps:
                method.render(step.camera, NullProbe())
        lines: dict[str, Any] = {one: Forced(method, one) for one in (AS_IT_IS, *in_frames)}
        rendered = render_in_turns(lines, scene, path, protocol, repeats, log)
        trained: dict[str, list[float]] = {one: [] for one in (AS_IT_IS, *in_training)}
        for _ in range(repeats):
            for kernel, seconds in trained.items():
                seconds.append(_trained(config, scene, kernel)[1])
    frame_ms = {row["setting"]: row["ms"] for row in rendered}
    return [
        {
            "method": name,
            "kernel": kernel.rpartition(".")[2],
            "frame_ms": frame_ms[AS_IT_IS],
            "frame_ms_reference": frame_ms.get(kernel),
            "training_s": median(trained[AS_IT_IS]),
            "training_s_reference": median(trained[kernel]) if kernel in trained else None,
        }
        for kernel in sorted(in_frames | in_training)
    ]


def _trained(config: DictConfig, scene: Scene, kernel: str) -> tuple[Method, float]:
    """The method, trained in a store of its own, and how many seconds that took."""
    with tempfile.TemporaryDirectory() as folder:
        method = build(config, "method")
        torch.manual_seed(config.seed)
        begun = time.perf_counter()
        with by_reference(kernel):
            method.fit(scene, build(config, "budget"), ConsoleLog(Path(folder), quiet=True))
        return method, time.perf_counter() - begun


def by_reference(kernel: str) -> AbstractContextManager[None]:
    """Inside, the reference computes `kernel`, a package; all as it is if that is `AS_IT_IS`."""
    from methods.kernels.dispatch import forced

    return nullcontext() if kernel == AS_IT_IS else forced(kernel, "reference")


class Forced:
    """A method that renders with one of its kernels computed by the reference."""

    def __init__(self, method: Method, kernel: str) -> None:
        self._method, self._kernel = method, kernel

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)

    def render(self, camera: Camera, probe: Probe) -> Frame:
        """The frame of the method."""
        with by_reference(self._kernel):
            return self._method.render(camera, probe)


def _line(row: Row) -> tuple[str, ...]:
    cells, saved = [], []
    for name, digits in (("frame_ms", 1), ("training_s", 2)):
        own, other = row[name], row[f"{name}_reference"]
        ratio = None if other is None else other / own
        cells += [decimal(own, digits), decimal(other, digits), decimal(ratio, 2)]
        saved += [] if ratio is None else [1 - 1 / ratio]
    return (row["method"], row["kernel"], *cells, f"{max(saved):.0%}")
