"""`steerbench worth`: what the fast version of each kernel brings to each method.

A method is trained for a moment. Then it renders the same frames, and trains as briefly again, in
turns: with all kernels as they are, and with one of them computed by its reference.
"""

import argparse
import tempfile
import time
from collections.abc import Collection, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from bench.measure import Task, measure
from bench.types import Camera, Frame, Method, NullProbe, Probe, Scene
from methods.kernels.dispatch import forced, kernel_calls
from reports.tables import Table, decimal
from sweeps.configured import build, checked_settings, protocol_of, scene_of, trained
from sweeps.overrides import choices, composed, swept
from sweeps.processes import device_lock
from sweeps.terminal import print_rows, show

COLUMNS = (
    *("method", "kernel", "frame, ms", "by its reference", "ratio"),
    *("training, s", "by its reference", "ratio", "brings"),
)
"""`brings`: the share that the fast version saves of a frame or of a training, the larger one."""

SETTINGS = (
    *("scene=totem", "scene.width=100", "trajectory=orbit", "budget=tiny", "protocol=study-1"),
    "protocol.compared=false",
)

Row = dict[str, Any]

AS_IT_IS = ""  # in place of the name of a kernel: none is computed by its reference


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line."""
    rows = _rows(options)
    if not rows:
        raise SteerbenchError(f"--filter: no kernel has {options.filter!r} in its name")
    title = "What the fast version of a kernel brings"
    show(Table(title, COLUMNS, tuple(map(_line, rows))))
    print_rows(rows)
    return 0


def _rows(options: argparse.Namespace) -> list[Row]:
    """The rows of the methods that the settings name; without `method=a,b`, of all methods that
    need no further setting."""
    words = options.overrides
    typed = [word.partition("=")[2] for word in words if word.startswith("method=")]
    names = swept(words).get("method", typed) or [
        name
        for name in choices("method", words)
        if not OmegaConf.missing_keys(composed([*words, f"method={name}"]).method)
    ]
    rest = [*SETTINGS, *(word for word in words if not word.startswith("method="))]
    return [row for name in names for row in _of_method([*rest, f"method={name}"], options)]


def _of_method(words: Sequence[str], options: argparse.Namespace) -> list[Row]:
    """A row for each kernel that the method in `words` calls."""

    def wanted(calls: Collection[str]) -> set[str]:
        return {kernel for kernel in calls if options.filter in kernel.rpartition(".")[2]}

    config = composed([*words, "exclusive=false"])  # its device is held here
    settings = checked_settings(config)
    log = ConsoleLog(Path(settings.outputs))
    scene, budget = scene_of(config), build(config, "budget")
    path = build(config, "trajectory", scene)
    protocol = replace(protocol_of(config), rounds=1 + options.repeats)
    task = Task(scene, path, protocol, budget, settings.seed, pictures=0)
    with device_lock(settings.device, log), tempfile.TemporaryDirectory() as folder:
        quiet = ConsoleLog(Path(folder), quiet=True)
        with kernel_calls() as in_training:
            method = trained(config, quiet, scene)
        with kernel_calls() as in_frames, torch.no_grad():
            method.reset()
            for step in path.steps[: method.memory + 1]:
                method.render(step.camera, NullProbe())
        kernels = (AS_IT_IS, *sorted(wanted(in_frames)))
        # Each line has the same training, but frames before of its own.
        lines = [Forced(trained(config, quiet, scene), kernel) for kernel in kernels]
        rendered = measure(lines, task, quiet)
        times: dict[str, list[float]] = {one: [] for one in (AS_IT_IS, *wanted(in_training))}
        for _ in range(options.repeats):
            for kernel, seconds in times.items():
                seconds.append(_training_s(config, scene, kernel))
    rows = (of.rows.set_index("metric")["value"] for of in rendered)
    frame_ms = {kernel: of["frame_ms"] for kernel, of in zip(kernels, rows, strict=True)}
    return [
        {
            "method": method.name,
            "kernel": kernel.rpartition(".")[2],
            "frame_ms": frame_ms[AS_IT_IS],
            "frame_ms_reference": frame_ms.get(kernel),
            "training_s": median(times[AS_IT_IS]),
            "training_s_reference": median(times[kernel]) if kernel in times else None,
        }
        for kernel in sorted(wanted(in_frames | in_training))
    ]


def _training_s(config: DictConfig, scene: Scene, kernel: str) -> float:
    """How many seconds a training takes."""
    with tempfile.TemporaryDirectory() as folder, by_reference(kernel):
        begun = time.perf_counter()
        trained(config, ConsoleLog(Path(folder), quiet=True), scene)
        return time.perf_counter() - begun


def by_reference(kernel: str) -> AbstractContextManager[None]:
    """Inside, the reference computes `kernel`, a package; all as it is if that is `AS_IT_IS`."""
    return nullcontext() if kernel == AS_IT_IS else forced(kernel, "reference")


class Forced:
    """A method that renders with one of its kernels computed by the reference."""

    def __init__(self, method: Method, kernel: str) -> None:
        self._method, self._kernel = method, kernel

    def __getattr__(self, name: str) -> Any:
        return getattr(self._method, name)

    def render(self, camera: Camera, probe: Probe) -> Frame:
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
