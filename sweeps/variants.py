"""Variants of one method on the same frames, each compared with the first of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.probes import StageClock
from bench.protocol import composite
from bench.trajectories import Step
from bench.types import Method, NullProbe, Scene
from sweeps.build import build
from sweeps.overrides import composed


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
        apart: mean PSNR against the first variant, dB; inf where there is no difference.
        worst: largest difference of a channel from the first variant.
        psnr: mean against the ground truth, dB; nan if no frame has one.
        frame_ms: median of the steady frames, and `stage_ms` of each of their stages.
        done: mean work of a steady frame, by counter.
    """

    variant: Variant
    method: Method
    apart: float
    worst: float
    psnr: float
    frame_ms: float
    stage_ms: dict[str, float]
    done: dict[str, float]


def render_variants(
    overrides: Sequence[str], variants: Sequence[Variant], frames: int, label: str
) -> list[Rendered]:
    """Render the first `frames` of the trajectory with every variant that can be used here.

    What a variant is trained from is trained if need be, or found.

    Args:
        overrides: settings of all variants, as of `steerbench run`.

    Raises:
        SteerbenchError: a setting is wrong, or the first variant cannot be used here.
    """
    if frames < 1:
        raise SteerbenchError(f"--frames: expected 1 or more, got {frames}")
    configs = [composed([*overrides, *variant.settings]) for variant in variants]
    log = ConsoleLog(Path(configs[0].outputs))
    scene = build(configs[0], "scene", log=log)
    steps = build(configs[0], "trajectory", scene).steps[:frames]
    found: list[Rendered] = []
    standard: list[Tensor] = []
    with log.progress(label, len(variants)) as progress:
        for variant, config in zip(variants, configs, strict=True):
            try:
                method = build(config, "method")
            except Unavailable as error:
                if not found:
                    raise
                log.info(f"{variant.name}: {error}")
                progress.advance()
                continue
            method.fit(scene, build(config, "budget"), log)
            pictures = _pictures(method, steps)
            standard = standard or pictures
            found.append(_compared(variant, method, pictures, standard, scene, steps))
            progress.advance()
    return found


def _pictures(method: Method, steps: Sequence[Step]) -> list[Tensor]:
    method.reset()
    return [method.render(step.camera, NullProbe()).rgb.cpu().clone() for step in steps]


def _compared(
    variant: Variant,
    method: Method,
    pictures: Sequence[Tensor],
    standard: Sequence[Tensor],
    scene: Scene,
    steps: Sequence[Step],
) -> Rendered:
    pairs = list(zip(pictures, standard, strict=True))
    true = [
        _psnr(picture, composite(scene.splits["test"].images[step.truth], scene.background).cpu())
        for picture, step in zip(pictures, steps, strict=True)
        if step.truth is not None
    ]
    clock = StageClock(method.settings()["device"])
    method.reset()
    for step in steps:
        with clock.frame():
            method.render(step.camera, clock)
    steady = clock.frames[min(method.memory, len(steps) - 1) :]
    return Rendered(
        variant,
        method,
        float(np.mean([_psnr(*pair) for pair in pairs])),
        max((one - other).abs().max().item() for one, other in pairs),
        float(np.mean(true)) if true else float("nan"),
        float(np.median([frame.total_ns for frame in steady])) / 1e6,
        {
            stage: float(np.median([frame.stages_ns.get(stage, 0) for frame in steady])) / 1e6
            for stage in dict.fromkeys(stage for frame in steady for stage in frame.stages_ns)
        },
        {
            counter: float(np.mean([frame.done.get(counter, 0) for frame in steady]))
            for counter in dict.fromkeys(name for frame in steady for name in frame.done)
        },
    )


def _psnr(picture: Tensor, other: Tensor) -> float:
    return -10 * torch.log10((picture - other).square().mean()).item()


def apart_text(psnr: float) -> str:
    """PSNR between two pictures for a table."""
    return f"{psnr:.1f}" if np.isfinite(psnr) else "the same"


def finite(row: dict[str, Any]) -> dict[str, Any]:
    """`row` with None, which JSON has, for figures that are not finite, which it has not."""
    return {
        key: None if isinstance(value, float) and not np.isfinite(value) else value
        for key, value in row.items()
    }
