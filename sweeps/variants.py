"""Variants of one method on the same frames, each compared with the first of them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra.utils import get_class
from omegaconf import DictConfig, OmegaConf

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.metrics import psnr_of_mse
from bench.protocol import EvaluationProtocol
from bench.results import COLD, STEADY, Measurement
from bench.run import measure
from bench.trajectories import Trajectory
from bench.types import Log, Method, Scene
from sweeps.build import build
from sweeps.measurement import checked_settings
from sweeps.overrides import CONFIGS, composed
from sweeps.turns import turn

LEAN = "methods.space_to_depth.SpaceToDepth"

RENDERED = "-rendered"
"""How the names of renderings end; see `bench.scoring`."""


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
        frames: that were rendered.
        apart: PSNR against the first variant, of all steady frames with ground truth together, as
            8-bit pictures, dB; inf where there is no difference.
        worst: largest difference of a channel from the first variant, of 1.
        values: of the steady frames and of the whole run, by metric, as `bench.run.measure` has
            them.
    """

    variant: Variant
    method: Method
    frames: int
    apart: float
    worst: float
    values: Mapping[str, float]


def render_variants(
    overrides: Sequence[str], variants: Sequence[Variant], frames: int, label: str
) -> list[Rendered]:
    """Measure the first `frames` of the trajectory, without LPIPS, with every variant that can be
    used here.

    What a variant is trained from is trained if need be, or found.

    Args:
        overrides: settings of all variants, as of `steerbench run`.

    Raises:
        SteerbenchError: a setting is wrong, the first variant cannot be used here, or there is no
            steady frame with ground truth among the first ones.
    """
    configs = [composed([*overrides, *variant.settings]) for variant in variants]
    settings = checked_settings(configs[0])
    log = ConsoleLog(Path(settings.outputs))
    scene, path, protocol = common_ground(configs[0], frames, log)
    found: list[Rendered] = []
    standard: dict[str, np.ndarray] = {}
    with (
        log.progress(label, len(variants)) as progress,
        turn(settings.device, log),
    ):
        for variant, config in zip(variants, configs, strict=True):
            method = usable_method(config, variant, log, required=not found)
            if method is not None:
                budget = build(config, "budget")
                measured = measure(
                    method, scene, path, protocol, budget, log, seed=settings.seed, pictures=frames
                )
                pictures = _steady_pictures(measured, frames)
                standard = standard or pictures
                found.append(_compared(variant, method, measured, pictures, standard))
            progress.advance()
    return found


def require_lean(config: DictConfig, purpose: str) -> None:
    """Refuse a method without the lean 2D renderer, which the command needs for its `purpose`."""
    if config.method.get("renderer", {}).get("_target_") != LEAN:
        raise SteerbenchError(
            f"{purpose}: expected a method with renderer=s2d, as method=steernerf"
        )


def common_ground(
    config: DictConfig, frames: int, log: Log
) -> tuple[Scene, Trajectory, EvaluationProtocol]:
    """What all variants render and are scored by: the first `frames` of the trajectory, and the
    protocol without LPIPS.

    Raises:
        SteerbenchError: a setting is wrong.
    """
    scene = build(config, "scene", log=log)
    path = build(config, "trajectory", scene)
    steps = path.steps[:frames]
    path = replace(path, name=f"{path.name}-first{len(steps)}", steps=steps)
    protocol = build(config, "protocol")
    return scene, path, replace(protocol, name=f"{protocol.name} without LPIPS", lpips=())


def usable_method(
    config: DictConfig, variant: Variant, log: Log, *, required: bool
) -> Method | None:
    """The method of `variant`, not yet trained. Where it cannot be used here: None, and the log is
    told; Unavailable if it is `required`."""
    torch.manual_seed(config.seed)
    try:
        return build(config, "method")
    except Unavailable as error:
        if required:
            raise
        log.info(f"{variant.name}: {error}")
        return None


def engines() -> Iterator[Variant]:
    """All engines at all precisions; torch in fp32, the standard, first."""
    names = sorted(path.stem for path in (CONFIGS / "engine").glob("*.yaml"))
    for name in sorted(names, key=lambda name: name != "torch"):
        node: Any = OmegaConf.load(CONFIGS / "engine" / f"{name}.yaml")
        kind: Any = get_class(node["_target_"])
        for precision in kind.precisions:
            settings = (f"engine={name}", f"precision={precision}")
            yield Variant(f"{name}, {precision}", settings)


def _steady_pictures(measured: Measurement, frames: int) -> dict[str, np.ndarray]:
    steady = measured.frames.loc[measured.frames["phase"] == STEADY, "frame"]
    names = {f"{frame:04d}{RENDERED}" for frame in steady}
    pictures = {name: pixels for name, pixels in measured.pictures.items() if name in names}
    if not pictures:
        raise SteerbenchError(
            f"--frames={frames}: none of these frames has a ground truth and as many frames before "
            "it as the method looks back on; give more"
        )
    return pictures


def _compared(
    variant: Variant,
    method: Method,
    measured: Measurement,
    pictures: Mapping[str, np.ndarray],
    standard: Mapping[str, np.ndarray],
) -> Rendered:
    apart = np.stack([pictures[name] / 255.0 - standard[name] / 255.0 for name in standard])
    rows = measured.rows[measured.rows["phase"] != COLD]
    return Rendered(
        variant,
        method,
        len(measured.frames),
        psnr_of_mse(float(np.square(apart).mean())),
        float(np.abs(apart).max()),
        dict(zip(rows["metric"], rows["value"], strict=True)),
    )


def apart_text(psnr: float) -> str:
    """PSNR between two pictures for a table."""
    return f"{psnr:.1f}" if math.isfinite(psnr) else "the same"


def finite(row: Mapping[str, Any]) -> dict[str, Any]:
    """`row` with None, which JSON has, for figures that are not finite, which it has not."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in row.items()
    }
