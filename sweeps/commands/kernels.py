"""`steerbench kernels`: error and throughput of every kernel; a wrong kernel is not timed.

`steerbench compile` compiles all of them now, not when they are first called. numba keeps compiled
code beside the sources until they change. A kernel is compiled by computing its cases, which covers
all types of inputs.

`--experiments` prints run time against error of those whose exact answer is known.

`--worth` prints what the fast version of each kernel brings to each method. A method is trained for
a moment. Then it renders the same frames, and trains as briefly again, in turns: with all kernels
as they are, and with one of them computed by its reference.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
import sys
import tempfile
import time
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from statistics import median
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from bench.case import failed, timed_rows
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, unexpected
from bench.experiments import experiment_rows
from bench.measure import Task, measure
from bench.types import Camera, Frame, Method, NullProbe, Probe, Scene
from methods import checks
from methods.kernels import compiled
from methods.kernels.dispatch import forced, kernel_calls
from reports.tables import Table, decimal
from sweeps.configured import build, checked_settings, protocol_of, scene_of
from sweeps.overrides import choices, composed, swept
from sweeps.processes import device_lock, processes
from sweeps.terminal import print_rows, show

COLUMNS = (
    *("kernel", "case", "backend", "dtype", "error", "tolerance"),
    *("M items/s", "ms", "by its reference", "ratio"),
)
"""`ratio`: time of the reference backend over time of this one, in the same case and run."""

OF_WORTH = (
    *("method", "kernel", "frame, ms", "by its reference", "ratio"),
    *("training, s", "by its reference", "ratio", "brings"),
)
"""`brings`: the share that the fast version saves of a frame or of a training, the larger one."""

OF_EXPERIMENTS = ("computed", "knob", "setting", "largest error ↓", "ms ↓", "observed order")

SETTINGS = (
    *("scene=totem", "scene.width=100", "trajectory=orbit", "budget=tiny", "protocol=study-1"),
    "protocol.compared=false",
)

Row = dict[str, Any]

AS_IT_IS = ""  # in place of the name of a kernel: none is computed by its reference


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line; return 1 if any kernel is wrong."""
    if options.command == "compile":
        return _compile()
    if options.overrides and not options.worth:
        raise unexpected("settings", "none without --worth", " ".join(options.overrides))
    if options.experiments:
        with device_lock("cpu", log := ConsoleLog(Path())):
            rows = experiment_rows(checks.found("experiments"), options.repeats, log)
        table = experiment_table(rows)
    elif options.worth:
        rows = _worth(options)
        title = "What the fast version of a kernel brings"
        table = Table(title, OF_WORTH, tuple(map(_line_of_worth, rows)))
    else:
        log, device = ConsoleLog(Path()), "cuda" if torch.cuda.is_available() else "cpu"
        cases = [case for case in checks.found("cases") if options.filter in case.subject]
        with device_lock("auto", log):
            rows = timed_rows(cases, device, compiled(device), options.repeats, log)
        table = Table("Kernels", COLUMNS, tuple(map(_line, _saving_most_first(rows))))
    if not rows:
        raise SteerbenchError(f"--filter: no kernel has {options.filter!r} in its name")
    show(table)
    print_rows(rows)
    return int(any(row.get("status", "ok") != "ok" for row in rows))


def _compile() -> int:
    """Compile the kernels for this CPU, on all cores; return 1 if one of them is wrong."""
    names = checks.modules("cases")
    with (
        processes(len(os.sched_getaffinity(0))) as pool,
        ConsoleLog(Path()).progress("compiling kernels", len(names)) as bar,
    ):
        wrong = []
        for ended in as_completed([pool.submit(wrong_of, name) for name in names]):
            wrong += ended.result()
            bar.advance()
    for case in sorted(wrong):
        print(f"wrong on this machine: {case}; see `steerbench kernels`", file=sys.stderr)
    return int(bool(wrong))


def wrong_of(module: str) -> list[str]:
    """Compute each quick case of `module` with compiled kernels; return the names of wrong ones."""
    quick = [case for case in importlib.import_module(module).cases() if case.quick]
    cells = [(case, cell) for case in quick for cell in case.tolerances if cell[0] == "cpu"]
    rows = [case.check(cell, "cpu") for case, cell in cells]
    return [f"{row['subject']}: {row['case']}" for row in rows if failed(row)]


def _saving_most_first(rows: Sequence[Row]) -> list[Row]:
    """What is wrong, then the fast versions, each with the time of its reference."""

    def computed(row: Row) -> tuple[str, ...]:
        return row["kernel"], row["case"], row["dtype"]

    reference_ms = {computed(row): row.get("ms") for row in rows if row["backend"] == "reference"}
    shown = (row for row in rows if row["backend"] != "reference" or row["status"] != "ok")
    compared = [{**row, "reference_ms": reference_ms.get(computed(row))} for row in shown]
    return sorted(compared, key=lambda row: row.get("ms", -math.inf) - (row["reference_ms"] or 0.0))


def _line(row: Mapping[str, Any]) -> tuple[str, ...]:
    labels = (row["kernel"], row["case"], row["backend"], row["dtype"], *errors(row))
    if row["status"] != "ok":
        return (*labels, "", row["status"], "", "")
    ratio = f"{row['ratio']:.1f}x" if "ratio" in row else ""
    times = (decimal(row[name], 2) for name in ("mitems_s", "ms", "reference_ms"))
    return (*labels, *times, ratio)


def errors(row: Mapping[str, Any]) -> tuple[str, str]:
    """The cells of the error of a check and of its tolerance."""
    error = "not finite" if row["error"] is None else f"{row['error']:.1e}"
    return error, "" if row["tolerance"] is None else f"{row['tolerance']:.1e}"


def _worth(options: argparse.Namespace) -> list[Row]:
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
    return [row for name in names for row in _rows_of_worth([*rest, f"method={name}"], options)]


def _rows_of_worth(words: Sequence[str], options: argparse.Namespace) -> list[Row]:
    """A row for each kernel that the method in `words` calls."""

    def wanted(calls: Collection[str]) -> set[str]:
        return {kernel for kernel in calls if options.filter in kernel.rpartition(".")[2]}

    config = composed(words)
    settings = checked_settings(config)
    log = ConsoleLog(Path(settings.outputs))
    scene, budget = scene_of(config), build(config, "budget")
    path = build(config, "trajectory", scene)
    protocol = replace(protocol_of(config), rounds=1 + options.repeats)
    task = Task(scene, path, protocol, budget, settings.seed, pictures=0)
    with device_lock(settings.device, log), tempfile.TemporaryDirectory() as folder:
        quiet = ConsoleLog(Path(folder), quiet=True)
        with kernel_calls() as in_training:
            method = _fitted(config, scene, folder)
        with kernel_calls() as in_frames, torch.no_grad():
            method.reset()
            for step in path.steps[: method.memory + 1]:
                method.render(step.camera, NullProbe())
        kernels = (AS_IT_IS, *sorted(wanted(in_frames)))
        # Each line has the same training, but frames before of its own.
        lines = [Forced(_fitted(config, scene, folder), kernel) for kernel in kernels]
        rendered = measure(lines, task, quiet)
        trained: dict[str, list[float]] = {one: [] for one in (AS_IT_IS, *wanted(in_training))}
        for _ in range(options.repeats):
            for kernel, seconds in trained.items():
                seconds.append(_training_s(config, scene, kernel))
    rows = (of.rows.set_index("metric")["value"] for of in rendered)
    frame_ms = {kernel: of["frame_ms"] for kernel, of in zip(kernels, rows, strict=True)}
    return [
        {
            "method": method.name,
            "kernel": kernel.rpartition(".")[2],
            "frame_ms": frame_ms[AS_IT_IS],
            "frame_ms_reference": frame_ms.get(kernel),
            "training_s": median(trained[AS_IT_IS]),
            "training_s_reference": median(trained[kernel]) if kernel in trained else None,
        }
        for kernel in sorted(wanted(in_frames | in_training))
    ]


def _fitted(config: DictConfig, scene: Scene, folder: str) -> Method:
    """The method, trained, or with its training from the store in `folder`."""
    method: Method = build(config, "method")
    torch.manual_seed(config.seed)
    method.fit(scene, build(config, "budget"), ConsoleLog(Path(folder), quiet=True))
    return method


def _training_s(config: DictConfig, scene: Scene, kernel: str) -> float:
    """How many seconds a training takes."""
    with tempfile.TemporaryDirectory() as folder, by_reference(kernel):
        begun = time.perf_counter()
        _fitted(config, scene, folder)
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
        """The frame of the method."""
        with by_reference(self._kernel):
            return self._method.render(camera, probe)


def _line_of_worth(row: Row) -> tuple[str, ...]:
    cells, saved = [], []
    for name, digits in (("frame_ms", 1), ("training_s", 2)):
        own, other = row[name], row[f"{name}_reference"]
        ratio = None if other is None else other / own
        cells += [decimal(own, digits), decimal(other, digits), decimal(ratio, 2)]
        saved += [] if ratio is None else [1 - 1 / ratio]
    return (row["method"], row["kernel"], *cells, f"{max(saved):.0%}")


def experiment_table(rows: Sequence[Row]) -> Table:
    """One line per experiment: its first and last setting, and the observed order."""
    lines = []
    for subject, some in groupby(rows, lambda row: row["subject"]):
        first, *others = some
        ends = [first, *others[-1:]]
        order = ""
        if first["order"] is not None:
            span = f"{_setting(first['order_from'])} to {_setting(first['order_to'])}"
            order = f"{first['order']:.2f} ({span})"
        figures = zip(*map(_trial, ends), strict=True)
        lines.append((subject, first["knob"], *map(" to ".join, figures), order))
    title = "Run time against error, where the exact answer is known"
    return Table(title, OF_EXPERIMENTS, tuple(lines))


def _trial(row: Row) -> tuple[str, str, str]:
    return _setting(row["setting"]), f"{row['error']:.1e}", decimal(row["ms"], 2)


def _setting(value: float | str) -> str:
    """A short number, with powers of two below 1 as fractions; text is unchanged."""
    if isinstance(value, str):
        return value
    if 0 < value < 1 and math.frexp(value)[0] == 0.5:
        return f"1/{1 / value:.0f}"
    return f"{value:g}"
