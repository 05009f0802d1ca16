"""`steerbench parity`: what every engine and precision of the 2D renderer loses, and saves."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import get_class
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.probes import StageClock
from bench.protocol import composite
from bench.trajectories import Step
from bench.types import Log, Method, NullProbe, Scene
from reports.tables import Table, megabytes, number
from sweeps.build import build
from sweeps.overrides import CONFIGS, explain
from sweeps.terminal import console, rich_table

SETTINGS = ("method=steernerf", "trajectory=smooth")

COLUMNS = (
    "engine",
    "precision",
    "PSNR to fp32, dB ↑",
    "worst pixel ↓",
    "PSNR, dB ↑",
    "lost, dB ↓",
    "network, ms ↓",
    "frame, ms ↓",
    "network, MB ↓",
)


def main(options: argparse.Namespace) -> int:
    """Print a table and, as the last line, the same rows as JSON."""
    if options.frames < 1:
        raise SteerbenchError(f"--frames: expected 1 or more, got {options.frames}")
    overrides = [*SETTINGS, *options.overrides]
    try:
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            config = compose("run", overrides=overrides)
            engines = list(_engines(overrides))
    except (HydraException, OmegaConfBaseException) as error:
        raise explain(error, overrides) from error
    log = ConsoleLog(Path(config.outputs))
    method, budget = build(config, "method"), build(config, "budget")
    if not hasattr(method, "use"):
        raise SteerbenchError(f"method={method.name}: it has no 2D renderer, expected steernerf")
    scene = build(config, "scene", log=log)
    steps = build(config, "trajectory", scene).steps[: options.frames]
    method.fit(scene, budget, log)
    rows = _rows(method, engines, scene, steps, log)
    title = f"{method.name}, {scene.name}, {len(steps)} frames"
    console().print(rich_table(Table(title, COLUMNS, tuple(_line(row) for row in rows))))
    print(json.dumps(rows))
    return 0


def _engines(overrides: Sequence[str]) -> Iterator[DictConfig]:
    """The configurations of all engines at all precisions; torch in fp32, the standard, first."""
    names = sorted((path.stem for path in (CONFIGS / "engine").glob("*.yaml")), key=_torch_first)
    for name in names:
        target = compose("run", overrides=[*overrides, f"engine={name}"]).engine._target_
        kind: Any = get_class(target)
        for precision in kind.precisions:
            yield compose("run", overrides=[*overrides, f"engine={name}", f"precision={precision}"])


def _torch_first(name: str) -> bool:
    return name != "torch"


def _rows(
    method: Any, engines: Sequence[DictConfig], scene: Scene, steps: Sequence[Step], log: Log
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    standard: list[torch.Tensor] = []
    with log.progress("engines", len(engines)) as progress:
        for config in engines:
            try:
                method.use(build(config, "engine"))
            except Unavailable as error:
                log.info(str(error))
                progress.advance()
                continue
            pictures = _render(method, steps)
            standard = standard or pictures
            rows.append(
                {
                    **{key: method.settings()[key] for key in ("engine", "precision")},
                    **_errors(pictures, standard, scene, steps),
                    **_times(method, steps),
                    "bytes": method.sizes()["renderer2d"],
                }
            )
            rows[-1]["lost"] = rows[0]["psnr"] - rows[-1]["psnr"]
            progress.advance()
    return rows


def _render(method: Method, steps: Sequence[Step]) -> list[torch.Tensor]:
    method.reset()
    return [method.render(step.camera, NullProbe()).rgb.clone() for step in steps]


def _errors(
    pictures: Sequence[torch.Tensor],
    standard: Sequence[torch.Tensor],
    scene: Scene,
    steps: Sequence[Step],
) -> dict[str, float]:
    """Mean PSNR against the `standard` and the truth, and the largest error of a pixel."""
    apart, worst, true = [], 0.0, []
    for picture, other, step in zip(pictures, standard, steps, strict=True):
        apart.append(_psnr(picture, other))
        worst = max(worst, (picture - other).abs().max().item())
        if step.truth is not None:
            truth = composite(scene.splits["test"].images[step.truth], scene.background)
            true.append(_psnr(picture, truth))
    return {"psnr_to_fp32": float(np.mean(apart)), "worst": worst, "psnr": float(np.mean(true))}


def _psnr(picture: torch.Tensor, other: torch.Tensor) -> float:
    return -10 * torch.log10((picture.cpu() - other.cpu()).square().mean()).item()


def _times(method: Method, steps: Sequence[Step]) -> dict[str, float]:
    """Median milliseconds of a frame and of the network in it, of the steady frames."""
    clock = StageClock(method.settings()["device"])
    method.reset()
    for step in steps:
        with clock.frame():
            method.render(step.camera, clock)
    steady = clock.frames[min(method.memory, len(steps) - 1) :]
    return {
        "network_ms": float(np.median([f.stages_ns["renderer2d/network"] for f in steady])) / 1e6,
        "frame_ms": float(np.median([f.total_ns for f in steady])) / 1e6,
    }


def _line(row: dict[str, Any]) -> tuple[str, ...]:
    same = not np.isfinite(row["psnr_to_fp32"])
    return (
        row["engine"],
        row["precision"],
        "the same" if same else number(row["psnr_to_fp32"], 1),
        number(row["worst"], 4),
        number(row["psnr"], 2),
        number(row["lost"], 3),
        number(row["network_ms"], 2),
        number(row["frame_ms"], 1),
        megabytes(row["bytes"]),
    )
