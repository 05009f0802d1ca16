"""`steerbench scaling`: how time, work and memory of a frame grow along a method's axes."""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import DictConfig

from bench.accuracy import mean_figures, observed_order
from bench.cameras import frame_camera
from bench.clock import FrameRecord, StageClock, p99_to_p50
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, unexpected, unknown
from bench.memory import MemoryMeter
from bench.threads import torch_threads
from bench.types import Camera, Log, Method, Scene
from reports.tables import Table, decimal, megabytes
from sweeps.configured import build, checked_settings, scene_of
from sweeps.overrides import composed
from sweeps.processes import device_lock
from sweeps.terminal import print_rows, show
from sweeps.variants import METHOD, Row, amount, declared, settings

FEW_STEPS = "++budget.renderer_steps=8"  # A 2D renderer costs the same however long it was trained

SIZES = ((200, 200), (400, 400), (800, 800), (1920, 1080), (3840, 2160))


class Point(NamedTuple):
    """One measurement: a `value` of an `axis`, that the power is fitted to, and how it is shown.

    `settings` are the words for `steerbench run` that set it; `size` is the width and height of the
    frames, None: those of the trajectory.
    """

    axis: str
    value: float
    label: str
    settings: tuple[str, ...] = ()
    size: tuple[int, int] | None = None


def main(options: argparse.Namespace) -> int:
    """Print a table with the fitted exponents, then its rows as JSON in the last line."""
    words, launcher = settings(options, METHOD, "trajectory=smooth", FEW_STEPS)
    config = composed(words, return_hydra_config=True)
    if config.method.get("steps"):  # they would win over those of the budget
        words = ["method.steps=null", *words]
        config = composed(words, return_hydra_config=True)
    points = _points(config, options.axis)
    for point in points:
        composed([*words, *point.settings])  # refused before anything is measured
    work = partial(_rows, words, frames=options.frames)
    (rows,) = launcher.run(work, [points])
    axes: dict[str, list[Row]] = {}
    for row in rows:
        axes.setdefault(row["axis"], []).append(row)
    scene = rows[0]["scene"]
    method = config.hydra.runtime.choices.method
    title = f"{method} on {scene}, {rows[0]['frames']} frames"
    show(_table(title, axes))
    print_rows(rows)
    return 0


def _points(config: DictConfig, names: Sequence[str]) -> list[Point]:
    """The points of the axes `names`; by default, of all axes."""
    study = declared(config)
    axes = ("pixels", "threads", *study.axes)
    for name in names:
        if name not in axes:
            raise unknown("axis", name, axes)
    engine = config.hydra.runtime.choices.engine
    if "threads" in (names or axes) and "engine" in config.method and engine != "torch":
        others = [name for name in axes if name != "threads"]
        raise SteerbenchError(
            "--axis threads: expected engine=torch, whose threads can be chosen afterwards; for "
            f"another engine give --axis {', '.join(others[:-1])} or {others[-1]}"
        )
    points = [Point("pixels", w * h, f"{w} x {h}", size=(w, h)) for w, h in SIZES]
    for threads in range(1, torch.get_num_threads() + 1):
        label = f"{threads} thread{'s' * (threads > 1)}"
        points.append(Point("threads", threads, label, (f"threads={threads}",)))
    for name, axis in study.axes.items():
        for value, size in zip(axis.values, axis.size or axis.values, strict=True):
            label = axis.label.format(value)
            points.append(Point(name, size, label, (f"{axis.setting}={value}",)))
    return [point for point in points if point.axis in (names or axes)]


def _rows(words: Sequence[str], points: Sequence[Point], frames: int) -> list[Row]:
    config = composed(words)
    log, scene = ConsoleLog(Path(checked_settings(config).outputs)), scene_of(config)
    rows = []
    with log.progress("scaling", len(points)) as progress, device_lock(config.device, log):
        for point in points:
            row = _row(point, composed([*words, *point.settings]), scene, frames, log)
            rows.append({"scene": scene.name, **row})
            progress.advance(note=point.label)
    return rows


def _row(point: Point, config: DictConfig, scene: Scene, frames: int, log: Log) -> Row:
    """Time, work and memory of the first steady `frames` of the trajectory at `point`."""
    torch.manual_seed(config.seed)
    method: Method = build(config, "method")
    method.fit(scene, build(config, "budget"), log)
    cameras = [step.camera for step in build(config, "trajectory", scene).steps]
    cameras = cameras[: method.memory + frames]
    if len(cameras) <= method.memory:
        expected = f"more than the {method.memory} frames that {method.name} looks back on"
        raise unexpected("trajectory", expected, len(cameras))
    if point.size:
        cameras = [frame_camera(camera, *point.size) for camera in cameras]
    with torch_threads(config.threads or torch.get_num_threads()):  # trained with the default
        records, peak_bytes = _render(method, cameras, log)
    frame_ms = statistics.mean(record.total_ns for record in records) / 1e6
    return {
        "axis": point.axis,
        "label": point.label,
        "value": point.value,
        "frames": len(records),
        "frame_ms": frame_ms,
        "fps": 1e3 / frame_ms,
        "p99_to_p50": p99_to_p50(records),
        **mean_figures("work", [record.done for record in records]),
        "peak_bytes": peak_bytes,
        "size_bytes": sum(method.sizes().values()),
    }


@torch.no_grad()
def _render(
    method: Method, cameras: Sequence[Camera], log: Log
) -> tuple[Sequence[FrameRecord], int]:
    """Records of the steady frames in the second of two rounds through `cameras`; peak memory."""
    device = method.settings()["device"]
    clock, meter = StageClock(device), MemoryMeter(device)
    with log.progress("rendering", 2 * len(cameras)) as progress:
        for _ in range(2):
            method.reset()
            for camera in cameras:
                with meter, clock.frame():
                    method.render(camera, clock)
                progress.advance()
    return clock.frames[len(cameras) + method.memory :], meter.peak_bytes


def _table(title: str, axes: Mapping[str, Sequence[Row]]) -> Table:
    """All rows, and below those of each axis the exponent with which each figure grows."""
    names = dict.fromkeys(name for rows in axes.values() for row in rows for name in row)
    counters = [name for name in names if name.startswith("work.")]
    figures = {
        "frame_ms": ("ms / frame ↓", lambda ms: decimal(ms, 1)),
        "p99_to_p50": ("p99 / p50 ↓", lambda ratio: decimal(ratio, 2)),
        "fps": ("FPS ↑", lambda fps: decimal(fps, 2)),
        **{name: (name.removeprefix("work.").replace("_", " "), amount) for name in counters},
        "peak_bytes": ("peak, MB ↓", megabytes),
        "size_bytes": ("model, MB ↓", megabytes),
    }
    lines = []
    for axis, rows in axes.items():
        for row in rows:
            cells = (write(row.get(name, 0)) for name, (_, write) in figures.items())
            lines.append((row["label"], *cells))
        powers = (
            "" if name in ("p99_to_p50", "fps") else decimal(growth(rows, name), 2)
            for name in figures
        )
        lines.append((f"exponent of {axis}", *powers))
    return Table(title, ("", *(label for label, _ in figures.values())), tuple(lines))


def growth(rows: Sequence[Row], figure: str) -> float:
    """The exponent p of `figure` ~ value^p by least squares on the logarithms; nan if fewer than
    two values are above 0."""
    used = [row for row in rows if row["value"] > 0 and row.get(figure, 0) > 0]
    values = [row["value"] for row in used]
    if len(set(values)) < 2:
        return math.nan
    return observed_order(values, [row[figure] for row in used])
