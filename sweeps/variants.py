"""Variants of one method on the same frames, each compared with the first of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from bench.accuracy import render_in_turns, steady_frames
from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.protocol import EvaluationProtocol
from bench.trajectories import Trajectory
from bench.types import Log, Method, Scene
from reports.tables import decimal
from sweeps.build import build
from sweeps.measurement import checked_settings
from sweeps.overrides import CONFIGS, composed
from sweeps.turns import turn

LEAN = "methods.steernerf.beyond.lean_renderer.SpaceToDepth"


@dataclass(frozen=True)
class Variant:
    """A variant by its `name`, and the `settings` that make it."""

    name: str
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Rendered:
    """What a variant rendered.

    Attributes:
        method: as it was used.
        scene, path: what all variants rendered.
        values: see `bench.accuracy.render_in_turns`.
    """

    name: str
    method: Method
    scene: Scene
    path: Trajectory
    values: Mapping[str, Any]

    @property
    def frames(self) -> int:
        """Frames of the path."""
        return len(self.path.steps)


def render_variants(
    variants: Mapping[str, Sequence[str]], frames: int, repeats: int
) -> list[Rendered]:
    """Render the first `frames` of the trajectory with all variants that can be used here, in turn;
    see `bench.accuracy.render_in_turns`.

    What a variant is trained from is trained if need be, or found.

    Args:
        variants: by name the settings of each, as of `steerbench run`. Scene, trajectory and
            protocol, but for its lookahead, are those of the first.

    Raises:
        SteerbenchError: a setting is wrong, the first variant cannot be used here, or there is no
            steady frame with ground truth among the first ones.
    """
    configs = {name: composed(overrides) for name, overrides in variants.items()}
    first = next(iter(configs.values()))
    settings = checked_settings(first)
    log = OnceLog(Path(settings.outputs))
    methods = usable(configs, log)
    scene, path, protocol = common_ground(first, frames, log)
    with turn(settings.device, log):
        fit_each(methods, configs, scene, path, log)
        told = [name for name in methods if configs[name].protocol.lookahead]
        rows = render_in_turns(methods, scene, path, protocol, repeats, log, told)
    return [Rendered(row["setting"], methods[row["setting"]], scene, path, row) for row in rows]


def settings_of(overrides: Sequence[str], variants: Iterable[Variant]) -> dict[str, list[str]]:
    """By the name of each variant its settings after those of all."""
    return {variant.name: [*overrides, *variant.settings] for variant in variants}


def usable(configs: Mapping[str, DictConfig], log: Log) -> dict[str, Method]:
    """The methods that can be used here. Of others the log is told why.

    Raises:
        Unavailable: the first of them cannot be used.
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
        SteerbenchError: no frame of `path` is good for all.
    """
    steady_frames(methods.values(), path)
    with log.progress("variants", len(methods)) as progress:
        for name, method in methods.items():
            torch.manual_seed(configs[name].seed)
            method.fit(scene, build(configs[name], "budget"), log)
            progress.advance(note=name)


class OnceLog(ConsoleLog):
    """A log that says nothing twice: most variants find the same training."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._said: set[str] = set()

    def info(self, message: str) -> None:
        if message not in self._said:
            self._said.add(message)
            super().info(message)


def require_lean(config: DictConfig, purpose: str) -> None:
    """Refuse a method without the lean 2D renderer, which the command needs for its `purpose`."""
    if config.method.get("renderer", {}).get("_target_") != LEAN:
        raise SteerbenchError(
            f"{purpose}: expected a method with renderer=s2d, as method=steernerf"
        )


def reprojects_exactly(config: DictConfig) -> bool:
    """Whether frames are reprojected as `method=steernerf` does it, which the refresh needs."""
    exact = composed(["method=steernerf"]).method.pipeline.reprojection
    return bool(config.method.pipeline.reprojection == exact)


def common_ground(
    config: DictConfig, frames: int, log: Log
) -> tuple[Scene, Trajectory, EvaluationProtocol]:
    """What all variants render and are scored by: the first `frames` of the trajectory, and the
    protocol without LPIPS.

    Raises:
        SteerbenchError: a setting is wrong, or the scene does not suit the protocol.
    """
    scene = build(config, "scene", log=log)
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


def engines() -> Iterator[Variant]:
    """All engines at all precisions; torch in fp32, the standard, first."""
    for name, kind in engine_kinds().items():
        for precision in kind.precisions:
            settings = (f"engine={name}", f"precision={precision}")
            yield Variant(f"{name}, {precision}", settings)


def engine_kinds() -> dict[str, Any]:
    """The class of each engine by its name; torch, the standard, first."""
    names = sorted(path.stem for path in (CONFIGS / "engine").glob("*.yaml"))
    nodes: dict[str, Any] = {
        name: OmegaConf.load(CONFIGS / "engine" / f"{name}.yaml")
        for name in sorted(names, key=lambda name: name != "torch")
    }
    return {name: get_class(node["_target_"]) for name, node in nodes.items()}


def apart_text(psnr: float) -> str:
    """PSNR between two pictures for a table."""
    return f"{psnr:.1f}" if math.isfinite(psnr) else "the same"


def finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """`row` with None, which JSON has, for figures that are not finite, which it has not."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }


def range_text(values: Mapping[str, Any]) -> str:
    """The mean times of a frame of the fastest and of the slowest round, for a table."""
    return f"{decimal(values['ms_lo'], 1)} – {decimal(values['ms_hi'], 1)}"
