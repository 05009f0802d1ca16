"""Renders variants of a method on the same frames, and compares each with the first."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
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
from reports.tables import decimal, spread
from sweeps.build import build, engine_kinds, target_of
from sweeps.configured import checked_settings, scene_of
from sweeps.device_lock import device_lock
from sweeps.execute import Launcher, divided
from sweeps.overrides import choices, composed, folder_words

Row = dict[str, Any]

METHOD = "method=steernerf_lean"
"""The method that is studied by default."""


@dataclass(frozen=True)
class Rendered:
    """The result of rendering a variant.

    Attributes:
        name: of the variant.
        method, scene, trajectory, resolution: their names in rows.
        frames: number of frames of the path.
        study: what its method declares.
        bytes: the sizes of the fitted method.
        values: its row, as made by `bench.accuracy.render_in_turns`.
    """

    name: str
    method: str
    scene: str
    trajectory: str
    resolution: str
    frames: int
    study: Study
    bytes: Mapping[str, int]
    values: Mapping[str, Any]

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


@dataclass(frozen=True)
class Fitted:
    """Methods fitted to one scene, by variant, and what all of them render.

    Attributes:
        trajectory: its first frames.
        protocol: without LPIPS.
    """

    configs: Mapping[str, DictConfig]
    methods: Mapping[str, Method]
    scene: Scene
    trajectory: Trajectory
    protocol: EvaluationProtocol
    log: Log


def settings(options: argparse.Namespace, *usual: str) -> tuple[list[str], Launcher]:
    """The settings of a study, the `usual` ones before those typed, and where it is computed.

    Raises:
        SteerbenchError: a setting is wrong.
    """
    typed, of_hydra = divided(options.overrides)
    words = [*usual, *typed]
    outputs = Path(checked_settings(composed(words)).outputs)
    return words, Launcher([*folder_words(words), *of_hydra], outputs)


def render_variants(
    variants: Mapping[str, Sequence[str]], options: argparse.Namespace, launcher: Launcher
) -> list[Rendered]:
    """Render the first `options.frames` of the trajectory with all usable variants in turns.

    Stages are trained unless they are stored already. `options.repeats` rounds are timed.

    Args:
        variants: by name, the words of each variant, as for `steerbench run`. Scene, trajectory and
            protocol are those of the first one.

    Raises:
        SteerbenchError: a setting is wrong, the first variant cannot be used here, or none of the
            frames is steady and has a ground truth.
    """
    work = partial(_rendered, frames=options.frames, repeats=options.repeats)
    (rendered,) = launcher.run(work, [variants])
    return rendered


def _rendered(variants: Mapping[str, Sequence[str]], frames: int, repeats: int) -> list[Rendered]:
    with fitted(variants, frames) as each:
        rows = render_in_turns(
            each.methods, each.scene, each.trajectory, each.protocol, repeats, each.log
        )
    path = each.trajectory
    return [
        Rendered(
            *(name, method.name, each.scene.name, path.name, path.resolution, len(path.steps)),
            study=declared(each.configs[name]),
            bytes=method.sizes(),
            values=row,
        )
        for (name, method), row in zip(each.methods.items(), rows, strict=True)
    ]


@contextmanager
def fitted(variants: Mapping[str, Sequence[str]], frames: int) -> Iterator[Fitted]:
    """Fit the methods of `variants` and hold the lock of their device.

    Those that cannot be used here are left out; the log says why. Raises as `render_variants` does,
    before anything is trained.
    """
    configs = {name: composed(words) for name, words in variants.items()}
    first = next(iter(configs.values()))
    settings = checked_settings(first)
    log = _OnceLog(Path(settings.outputs))
    methods = _usable(configs, log)
    scene, path, protocol = common_ground(first, frames)
    steady_frames(methods.values(), path)
    with device_lock(settings.device, log):
        with log.progress("variants", len(methods)) as progress:
            for name, method in methods.items():
                torch.manual_seed(configs[name].seed)
                method.fit(scene, build(configs[name], "budget"), log)
                progress.advance(note=name)
        yield Fitted(configs, methods, scene, path, protocol, log)


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


def _usable(configs: Mapping[str, DictConfig], log: Log) -> dict[str, Method]:
    """The methods that can be used here, of which the first is one; the log says why not others."""
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


class _OnceLog(ConsoleLog):
    """A log that omits repeated messages, because most variants load the same training."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._said: set[str] = set()

    def info(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            super().info(message)


def declared(config: DictConfig) -> Study:
    """The study that the method of `config` declares."""
    return study_of(target_of(config.method))


def computes_with_engine(config: DictConfig) -> bool:
    """Whether the method of `config` has a network that an engine runs."""
    return "engine" in config.method


def settings_of(words: Sequence[str], variants: Iterable[Variant]) -> dict[str, list[str]]:
    """The words of each variant, by its name: the common `words`, then its own settings."""
    return {variant.name: [*words, *variant.settings] for variant in variants}


def engines(words: Sequence[str] = ()) -> list[Variant]:
    """All engines at all precisions; torch in fp32, the standard, first."""
    return [
        Variant(f"{name}, {precision}", (f"engine={name}", f"precision={precision}"))
        for name, kind in engine_kinds(choices("engine", words)).items()
        for precision in kind.precisions
    ]


COMPARED = ("PSNR to the first, dB ↑", "PSNR, dB ↑", "lost, dB ↓", "frame, ms ↓", "of rounds")
"""The columns of `compared_cells`."""


def compared(variant: Rendered, first: Rendered) -> Row:
    """Error and time of a variant compared with the first one."""
    return {
        "apart": variant.values["psnr_to_first"],
        "psnr": variant.values["psnr"],
        "lost": first.values["psnr"] - variant.values["psnr"],
        **times(variant),
    }


def times(variant: Rendered) -> Row:
    """The time of a variant's frame, its range over the rounds, and how far its tail reaches."""
    of_rounds = {name: variant.values[name] for name in ("ms_lo", "ms_hi", "p99_to_p50")}
    return {"frame_ms": variant.values["ms"], **of_rounds}


def compared_cells(row: Row) -> tuple[str, ...]:
    """The cells of a `compared` row, as text, for the columns `COMPARED`."""
    apart = row["apart"]
    return (
        decimal(apart, 1) if math.isfinite(apart) else "the same",
        decimal(row["psnr"], 2),
        decimal(row["lost"], 3),
        decimal(row["frame_ms"], 1),
        spread(row["ms_lo"], row["ms_hi"]),
    )


def amount(value: float) -> str:
    """Format a count: 12,345 or 1.23 M."""
    for size, letter in ((1e9, "G"), (1e6, "M")):
        if value >= size:
            return f"{decimal(value / size, 2)} {letter}"
    return decimal(value, 0)
