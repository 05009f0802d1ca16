"""Renders variants of a method on the same frames, and compares each with the first."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from bench.accuracy import render_in_turns, steady_frames
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.protocol import EvaluationProtocol
from bench.study import Study, Variant, study_of
from bench.trajectories import Trajectory
from bench.types import Log, Method, Scene
from reports.tables import decimal
from sweeps.build import build, engine_kinds, target_of
from sweeps.configured import checked_settings, scene_of
from sweeps.device_lock import device_lock
from sweeps.overrides import composed

Row = dict[str, Any]

METHOD = "method=steernerf_lean"
"""The method that is studied by default."""


@dataclass(frozen=True)
class Rendered:
    """The result of rendering a variant.

    Attributes:
        study: what its method declares.
        method: the fitted method.
        scene, path: what all variants rendered.
        values: its row, see `bench.accuracy.render_in_turns`.
    """

    name: str
    study: Study
    method: Method
    scene: Scene
    path: Trajectory
    values: Mapping[str, Any]

    @property
    def frames(self) -> int:
        """Number of frames of the path."""
        return len(self.path.steps)

    @property
    def network_ms(self) -> float | None:
        """The time of the stage that the engine computes; None if the method declares none."""
        return self.values.get(f"stage_ms.{self.study.network_stage}")

    def work(self) -> dict[str, float]:
        """The work counters of a frame, without the `dense` ones."""
        return {
            name.removeprefix("work."): value
            for name, value in self.values.items()
            if name.startswith("work.") and not name.endswith(".dense")
        }


def declared(config: DictConfig) -> Study:
    """The study that the method of `config` declares."""
    return study_of(target_of(config.method))


def computes_with_engine(config: DictConfig) -> bool:
    """Whether the method of `config` has a network that an engine runs."""
    return "engine" in config.method


def render_variants(
    variants: Mapping[str, Sequence[str]], frames: int, repeats: int
) -> list[Rendered]:
    """Render the first `frames` of the trajectory with all usable variants in turn.

    See `bench.accuracy.render_in_turns`. Stages are trained unless they are stored already.

    Args:
        variants: by name, the words of each variant, as for `steerbench run`. Scene, trajectory and
            protocol are those of the first one.

    Raises:
        SteerbenchError: a setting is wrong, the first variant cannot be used here, or none of the
            frames is steady and has a ground truth.
    """
    configs = {name: composed(words) for name, words in variants.items()}
    first = next(iter(configs.values()))
    settings = checked_settings(first)
    log = OnceLog(Path(settings.outputs))
    methods = usable(configs, log)
    scene, path, protocol = common_ground(first, frames)
    with device_lock(settings.device, log):
        fit_each(methods, configs, scene, path, log)
        rows = render_in_turns(methods, scene, path, protocol, repeats, log)
    return [
        Rendered(name, declared(configs[name]), method, scene, path, row)
        for (name, method), row in zip(methods.items(), rows, strict=True)
    ]


def settings_of(words: Sequence[str], variants: Iterable[Variant]) -> dict[str, list[str]]:
    """The words of each variant, by its name: the common `words`, then its own settings."""
    return {variant.name: [*words, *variant.settings] for variant in variants}


def usable(configs: Mapping[str, DictConfig], log: Log) -> dict[str, Method]:
    """The methods that can be used here; the log says why others cannot.

    Raises:
        Unavailable: the first method cannot be used.
    """
    methods: dict[str, Method] = {}
    for name, config in configs.items():
        torch.manual_seed(config.seed)
        try:
            methods[name] = build(config, "method")
        except Unavailable as error:
            if not methods:
                raise
            log.info(f"{name}: {error}")
    return methods


def fit_each(
    methods: Mapping[str, Method],
    configs: Mapping[str, DictConfig],
    scene: Scene,
    path: Trajectory,
    log: Log,
) -> None:
    """Fit all `methods`, each with the budget of its config.

    Raises, before anything is trained:
        SteerbenchError: no frame of `path` with a ground truth is steady for all methods.
    """
    steady_frames(methods.values(), path)
    with log.progress("variants", len(methods)) as progress:
        for name, method in methods.items():
            torch.manual_seed(configs[name].seed)
            method.fit(scene, build(configs[name], "budget"), log)
            progress.advance(note=name)


class OnceLog(ConsoleLog):
    """A log that omits repeated messages, because most variants load the same training."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._said: set[str] = set()

    def info(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            super().info(message)


def common_ground(config: DictConfig, frames: int) -> tuple[Scene, Trajectory, EvaluationProtocol]:
    """What all variants share: scene, first `frames` of the trajectory, protocol without LPIPS.

    Raises:
        SteerbenchError: a setting is wrong, or the scene does not fit the protocol.
    """
    scene = scene_of(config)
    path = build(config, "trajectory", scene)
    steps = path.steps[:frames]
    path = replace(path, name=f"{path.name}-first{len(steps)}", steps=steps)
    protocol = build(config, "protocol")
    protocol = replace(protocol, name=f"{protocol.name} without LPIPS", lpips=())
    if protocol.memory != "steady":
        raise SteerbenchError(
            "protocol.memory: expected steady, where frames follow each other in turns, got "
            f"{protocol.memory}"
        )
    protocol.check(scene, path)
    return scene, path, protocol


def engines(words: Sequence[str] = ()) -> list[Variant]:
    """All engines at all precisions; torch in fp32, the standard, first."""
    return [
        Variant(f"{name}, {precision}", (f"engine={name}", f"precision={precision}"))
        for name, kind in engine_kinds(words).items()
        for precision in kind.precisions
    ]


def print_rows(rows: Iterable[Mapping[str, Any]]) -> None:
    """Print `rows` as one line of JSON, with null for figures that are not finite."""
    print(json.dumps([finite(row) for row in rows]))


def finite(row: Mapping[str, Any]) -> Row:
    """`row` with None for figures that are not finite."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


COMPARED = (
    "PSNR to the first, dB ↑",
    "PSNR, dB ↑",
    "lost, dB ↓",
    "frame, ms ↓",
    "of rounds",
)
"""The columns of `compared_cells`."""


def compared(one: Rendered, first: Rendered) -> Row:
    """Error and time of a variant compared with the first one."""
    values = one.values
    return {
        "apart": values["psnr_to_first"],
        "psnr": values["psnr"],
        "lost": first.values["psnr"] - values["psnr"],
        "frame_ms": values["ms"],
        **{name: values[name] for name in ("ms_lo", "ms_hi", "p99_to_p50")},
    }


def compared_cells(row: Row) -> tuple[str, ...]:
    """The cells of a `compared` row, as text; see `COMPARED`."""
    apart = row["apart"]
    return (
        decimal(apart, 1) if math.isfinite(apart) else "the same",
        decimal(row["psnr"], 2),
        decimal(row["lost"], 3),
        decimal(row["frame_ms"], 1),
        range_text(row),
    )


def range_text(values: Mapping[str, Any]) -> str:
    """Mean frame times of the fastest and the slowest round, as text."""
    return f"{decimal(values['ms_lo'], 1)} – {decimal(values['ms_hi'], 1)}"


def amount(value: float) -> str:
    """Format a count: 12,345 or 1.23 M."""
    for size, letter in ((1e9, "G"), (1e6, "M")):
        if value >= size:
            return f"{decimal(value / size, 2)} {letter}"
    return decimal(value, 0)
