"""`steerbench scaling`: how time and memory of a frame grow with its size, L, K, T and threads."""

from __future__ import annotations

import argparse
import json
import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from bench.lookahead import announce_next
from omegaconf import DictConfig

from bench.cameras import frame_camera
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, explained
from bench.frontier import observed_order
from bench.probes import FrameRecord, MemoryMeter, StageClock, p99_to_p50
from bench.threads import torch_threads
from bench.types import Camera, Log, Method, Scene
from reports.figures import growth_panels
from reports.tables import Table, decimal, megabytes
from sweeps.build import build
from sweeps.measurement import checked_settings
from sweeps.overrides import composed
from sweeps.terminal import console, rich_table
from sweeps.turns import turn

SETTINGS = ("method=steernerf", "trajectory=smooth", "budget.renderer_steps=8")
"""What a 2D renderer has learned does not change what it costs."""

TORCH = "methods.engines.torch_engine.TorchEngine"

SIZES = ((200, 200), (400, 400), (800, 800), (1920, 1080), (3840, 2160))

COLUMNS = (
    "",
    "ms / frame ↓",
    "latency, ms ↓",
    "p99 / p50 ↓",
    "FPS ↑",
    "field samples",
    "peak, MB ↓",
    "model, MB ↓",
)


@dataclass(frozen=True)
class Point:
    """One measurement.

    Attributes:
        axis: what is varied.
        value: of that, in the unit that the cost is fitted over.
        label: the value as it is shown.
        settings: that make it, as of `steerbench run`.
        size: width and height of the frames; None: as the trajectory has them.
        threads: None: as many as usual.
    """

    axis: str
    value: float
    label: str
    settings: tuple[str, ...] = ()
    size: tuple[int, int] | None = None
    threads: int | None = None


def _points() -> Iterator[Point]:
    for width, height in SIZES:
        yield Point("pixels", width * height, f"{width} x {height}", size=(width, height))
    for threads in range(1, torch.get_num_threads() + 1):
        yield Point("threads", threads, f"{threads} thread{'s' * (threads > 1)}", threads=threads)
    for frames in (0, 1, 2, 3):
        yield Point("L", frames, f"L = {frames}", (f"method.pipeline.frames={frames}",))
    for channels in (3, 6, 9):
        yield Point("K", channels, f"K = {channels}", (f"method.pipeline.channels={channels}",))
    for log2 in (14, 16, 17, 19):
        yield Point("T", 2**log2, f"T = 2^{log2}", (f"method.grid.log2_table={log2}",))


def main(options: argparse.Namespace) -> int:
    """Print a table with the fitted exponents and, as the last line, the rows as JSON."""
    if options.plot is not None and options.plot.suffix != ".png":
        raise SteerbenchError(f"--plot: expected a name that ends in .png, got {options.plot}")
    overrides = [*SETTINGS, *options.overrides]
    config = composed(overrides)
    outputs = Path(checked_settings(config).outputs)
    points = [point for point in _points() if point.axis in (options.axis or [point.axis])]
    if "pipeline" not in config.method:
        raise SteerbenchError(
            "steerbench scaling varies L and K: expected a method with a 2D renderer, as "
            "method=steernerf"
        )
    if config.engine._target_ != TORCH and any(point.threads for point in points):
        raise SteerbenchError(
            "--axis threads: expected engine=torch, whose threads can be chosen afterwards; for "
            "another engine give --axis pixels, L, K or T"
        )
    log = ConsoleLog(outputs)
    scene = build(config, "scene", log=log)
    configs = [composed([*overrides, *point.settings]) for point in points]
    rows = []
    with log.progress("scaling", len(points)) as progress, turn(config.device, log):
        for point, made in zip(points, configs, strict=True):
            rows.append(_row(point, made, scene, options.frames, log))
            progress.advance(note=point.label)
    title = f"{config.method.name} on {scene.name}, {rows[0]['frames']} frames"
    axes: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        axes.setdefault(row["axis"], []).append(row)
    lines = [line for of_axis in axes.values() for line in _lines(of_axis)]
    console().print(rich_table(Table(title, COLUMNS, tuple(lines))))
    print(json.dumps(rows))
    if options.plot is not None:
        _plot(axes, options.plot)
        log.info(f"plot: {options.plot}")
    return 0


def _row(point: Point, config: DictConfig, scene: Scene, frames: int, log: Log) -> dict[str, Any]:
    """Time, work and memory of the first steady `frames` of the trajectory, as `point` says."""
    torch.manual_seed(config.seed)
    method: Method = build(config, "method")
    method.fit(scene, build(config, "budget"), log)
    cameras = [step.camera for step in build(config, "trajectory", scene).steps]
    cameras = cameras[: method.memory + frames]
    if len(cameras) <= method.memory:
        raise SteerbenchError(
            f"trajectory: expected more than the {method.memory} frames that {method.name} looks "
            f"back on, got {len(cameras)}"
        )
    if point.size:
        cameras = [frame_camera(camera, *point.size) for camera in cameras]
    with torch_threads(point.threads or torch.get_num_threads()):  # trained with all, all the same
        records, peak_bytes = _render(method, cameras, config.protocol.lookahead, log)
    samples = [record.done["samples"] + record.done.get("surface_samples", 0) for record in records]
    return {
        "axis": point.axis,
        "label": point.label,
        "value": point.value,
        "frames": len(records),
        "frame_ms": statistics.mean(record.total_ns for record in records) / 1e6,
        "latency_ms": statistics.mean(record.latency_ns for record in records) / 1e6,
        "p99_to_p50": p99_to_p50(records),
        "samples": statistics.mean(samples),
        "peak_bytes": peak_bytes,
        "size_bytes": sum(method.sizes().values()),
    }


@torch.no_grad()
def _render(
    method: Method, cameras: Sequence[Camera], lookahead: bool, log: Log
) -> tuple[Sequence[FrameRecord], int]:
    """The steady frames of a sequence through `cameras`, the second time round, and the peak of
    memory in them; with `lookahead` the camera of the next frame is known."""
    device = method.settings()["device"]
    clock, meter = StageClock(device), MemoryMeter(device)
    with log.progress("rendering", 2 * len(cameras)) as progress:
        for _ in range(2):
            method.reset()
            for index, camera in enumerate(cameras):
                next_known = lookahead and announce_next(method, cameras, index)
                with meter, clock.frame(next_known):
                    method.render(camera, clock)
                progress.advance()
    return clock.frames[len(cameras) + method.memory :], meter.peak_bytes


def _lines(rows: Sequence[dict[str, Any]]) -> list[tuple[str, ...]]:
    """The rows of one axis, and below them how fast each figure grows."""
    lines = [
        (
            row["label"],
            decimal(row["frame_ms"], 1),
            decimal(row["latency_ms"], 1),
            decimal(row["p99_to_p50"], 2),
            decimal(1e3 / row["frame_ms"], 2),
            decimal(row["samples"], 0),
            megabytes(row["peak_bytes"]),
            megabytes(row["size_bytes"]),
        )
        for row in rows
    ]
    exponents = [growth(rows, name) for name in ("frame_ms", "samples", "peak_bytes", "size_bytes")]
    ms, samples, peak, size = (decimal(exponent, 2) for exponent in exponents)
    return [*lines, (f"exponent of {rows[0]['axis']}", ms, "", "", "", samples, peak, size)]


def _plot(axes: Mapping[str, Sequence[dict[str, Any]]], path: Path) -> None:
    figures = {"frame_ms": "ms / frame", "peak_bytes": "peak memory, bytes"}
    exponents = {(axis, key): growth(axes[axis], key) for axis in axes for key in figures}
    with explained(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        growth_panels(axes, figures, exponents, path)


def growth(rows: Sequence[dict[str, Any]], figure: str) -> float:
    """The exponent p of `figure` ~ value^p, a least-squares line through the logarithms; nan if
    there are fewer than two values above 0."""
    points = [(row["value"], row[figure]) for row in rows if row["value"] > 0 and row[figure] > 0]
    if len({value for value, _ in points}) < 2:
        return math.nan
    value, of = zip(*points, strict=True)
    return observed_order(value, of)
