"""Renders variants of a method on the same frames, and compares each with the first."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf

from bench.accuracy import render_in_turns, steady_frames
from bench.console import ConsoleLog
from bench.errors import Unavailable, unexpected
from bench.protocol import EvaluationProtocol
from bench.study import Study, Variant, study_of
from bench.trajectories import Trajectory
from bench.types import Log, Method, Scene
from reports.tables import decimal
from sweeps.configured import build, checked_settings, scene_of
from sweeps.execute import Launcher, divided
from sweeps.overrides import composed, engine_kinds, folder_words, target_of
from sweeps.processes import device_lock

Row = dict[str, Any]

METHOD = "method=steernerf"  # the method that is studied by default

AS_IT_IS = Variant("as it is")  # the settings as typed


class Ground(NamedTuple):
    """What all variants share: the first frames of the trajectory, the protocol without LPIPS."""

    scene: Scene
    trajectory: Trajectory
    protocol: EvaluationProtocol


def settings(options: argparse.Namespace, *usual: str) -> tuple[list[str], Launcher]:
    """The settings of a study, the `usual` ones before those typed, and where it is computed."""
    typed, of_hydra = divided(options.overrides)
    words = [*usual, *typed]
    outputs = Path(checked_settings(composed(words)).outputs)
    return words, Launcher([*folder_words(words), *of_hydra], outputs)


def render(
    variants: Mapping[str, Sequence[str]], options: argparse.Namespace, launcher: Launcher
) -> list[Row]:
    """Render the first `options.frames` of the trajectory with all usable variants in turns.

    `variants` are words as for `steerbench run`, by name. Scene, trajectory and protocol are those
    of the first one, which must be usable here. Stages are trained unless they are stored already;
    `options.repeats` rounds are timed. Returns the rows of `bench.accuracy.render_in_turns`, with
    method, scene, trajectory, resolution, number of `frames` and, as bytes.*, sizes of the method.
    """
    work = partial(_rendered, frames=options.frames, repeats=options.repeats)
    (rows,) = launcher.run(work, [variants])
    return rows


def _rendered(variants: Mapping[str, Sequence[str]], frames: int, repeats: int) -> list[Row]:
    with fitted(variants, frames) as (methods, ground, log):
        rows = render_in_turns(methods, *ground, repeats, log)
    path = ground.trajectory
    facts = {"scene": ground.scene.name, "trajectory": path.name, "resolution": path.resolution}
    for row, method in zip(rows, methods.values(), strict=True):
        row |= {"method": method.name, **facts, "frames": len(path.steps)}
        row |= {f"bytes.{name}": size for name, size in method.sizes().items()}
    return rows


@contextmanager
def fitted(
    variants: Mapping[str, Sequence[str]], frames: int
) -> Iterator[tuple[Mapping[str, Method], Ground, Log]]:
    """Fit the methods of `variants` to what they share, and hold the lock of their device.

    Those that cannot be used here are left out; the log says why. SteerbenchError, before anything
    is trained, if the first is one of them, or no frame is steady and has a ground truth.
    """
    configs = {name: composed(words) for name, words in variants.items()}
    first = next(iter(configs.values()))
    settings = checked_settings(first)
    log = ConsoleLog(Path(settings.outputs))
    # Each message once, because most variants load the same training.
    log.info = cache(log.info)  # type: ignore[method-assign]
    methods = _usable(configs, log)
    ground = common_ground(first, frames)
    steady_frames(methods.values(), ground.trajectory)
    with device_lock(settings.device, log):
        with log.progress("variants", len(methods)) as progress:
            for name, method in methods.items():
                torch.manual_seed(configs[name].seed)
                method.fit(ground.scene, build(configs[name], "budget"), log)
                progress.advance(note=name)
        yield methods, ground, log


def common_ground(config: DictConfig, frames: int) -> Ground:
    """What variants share, with the first `frames` of the trajectory; SteerbenchError if the scene
    does not fit the protocol."""
    scene = scene_of(config)
    path = build(config, "trajectory", scene)
    steps = path.steps[:frames]
    path = replace(path, name=f"{path.name}-first{len(steps)}", steps=steps)
    protocol = build(config, "protocol")
    protocol = replace(protocol, name=f"{protocol.name} without LPIPS", lpips=())
    if protocol.memory != "steady":
        expected = "steady, where frames follow each other in turns"
        raise unexpected("protocol.memory", expected, protocol.memory)
    protocol.check(scene, path)
    return Ground(scene, path, protocol)


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


def declared(config: DictConfig) -> Study:
    """The study that the method of `config` declares: its class or, if only that knows, an object.

    A method that still lacks a setting declares nothing.
    """
    target = target_of(config.method)
    if isinstance(getattr(target, "study", None), property):
        return Study() if OmegaConf.missing_keys(config.method) else build(config, "method").study
    return study_of(target)


def words_of(words: Sequence[str], variants: Iterable[Variant]) -> dict[str, list[str]]:
    """The words of each variant, by its name: the common `words`, then its own settings."""
    return {variant.name: [*words, *variant.settings] for variant in variants}


def nothing_skipped(study: Study) -> tuple[str, ...]:
    """The settings that switch off all skips."""
    return tuple(f"{setting}=false" for setting in study.skips.values())


def engines(words: Sequence[str] = ()) -> list[Variant]:
    """All engines at all precisions; torch in fp32, the standard, first."""
    return [
        Variant(f"{name}, {precision}", (f"engine={name}", f"precision={precision}"))
        for name, kind in engine_kinds(words).items()
        for precision in kind.precisions
    ]


def times(row: Row) -> Row:
    """The time of a variant's frame, its range over the rounds, and how far its tail reaches."""
    return {"frame_ms": row["ms"], **{x: row[x] for x in ("ms_lo", "ms_hi", "p99_to_p50")}}


def amount(value: float) -> str:
    """Format a count: 12,345 or 1.23 M."""
    for size, letter in ((1e9, "G"), (1e6, "M")):
        if value >= size:
            return f"{decimal(value / size, 2)} {letter}"
    return decimal(value, 0)
