"""One measurement from its configuration: built, looked up in the store or made, shown."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from rich.columns import Columns

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.provenance import code_digest, machine
from bench.results import Store
from bench.run import measure
from bench.types import Method, Scene
from reports.page import write_page
from reports.tables import blocks
from sweeps.build import build, check_settings
from sweeps.terminal import console, rich_table

PLACES = ("outputs", "report", "weights_dir")
"""Settings that say where things lie: they do not change a row."""


@dataclass(frozen=True)
class Settings:
    """The settings of a run that are no choices; run.yaml says what each of them means."""

    seed: int
    device: str
    backend: str
    threads: int | None
    outputs: str
    weights_dir: str | None
    report: str | None


def execute(config: DictConfig, command: Sequence[str]) -> None:
    """Measure what `config` describes unless the store has it, print it, write its page.

    Args:
        config: the composed run.yaml.
        command: what was typed, for the record.

    Raises:
        SteerbenchError: a setting is wrong, or something in the measurement went wrong.
    """
    settings = _settings(config)
    if settings.threads is not None:
        torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    root = Path(settings.outputs)
    log, store = ConsoleLog(root), Store(root)

    method, budget, protocol = (build(config, group) for group in ("method", "budget", "protocol"))
    scene = build(config, "scene", log=log)
    trajectory = build(config, "trajectory", scene)
    weights = Path(settings.weights_dir) if settings.weights_dir else None
    parts = _identity(config, scene, method) | {"lpips": protocol.find_lpips(weights, log)}
    run = store.key(parts)
    known = store.find(run) is not None
    if known:
        log.info(f"already measured; to measure again, remove {store.folder / run}")
    else:
        measurement = measure(
            method,
            scene,
            trajectory,
            protocol,
            budget,
            log,
            seed=settings.seed,
            weights_dir=weights,
        )
        record = {**measurement.record, "command": shlex.join(command)}
        store.save(parts, replace(measurement, record=record))
    _show(store, run, explain=known)
    if settings.report:
        log.info(f"report: {write_page(store, [run], Path(settings.report))}")


def _settings(config: DictConfig) -> Settings:
    values = {field.name: config[field.name] for field in fields(Settings)}
    check_settings(Settings, values)
    settings = Settings(**values)
    if settings.seed < 0:
        raise SteerbenchError(f"seed: expected 0 or more, got {settings.seed}")
    if settings.threads is not None and settings.threads < 1:
        raise SteerbenchError(f"threads: expected 1 or more, or null, got {settings.threads}")
    if not re.fullmatch(r"auto|cpu|cuda(:\d+)?", settings.device):
        raise SteerbenchError(f"device: expected auto, cpu, cuda or cuda:N, got {settings.device}")
    if settings.device.startswith("cuda") and not torch.cuda.is_available():
        raise Unavailable(f"device={settings.device}: torch sees no GPU here; use device=cpu")
    return settings


def _identity(config: DictConfig, scene: Scene, method: Method) -> dict[str, Any]:
    """Everything that can change the rows but for the weights at hand: what makes a run's key.

    Where scene and weights lie is not part of it.
    """
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    kept = {key: value for key, value in plain.items() if key not in PLACES}
    kept["scene"] = {k: v for k, v in plain["scene"].items() if k not in ("path", "root")}
    return {
        "code": code_digest(),
        "config": kept,
        "scene": scene.digest,
        "resolved": method.settings(),
        "threads": torch.get_num_threads(),
        "machine": {k: v for k, v in machine().items() if k in ("cpu", "gpus", "versions")},
    }


def _show(store: Store, run: str, explain: bool) -> None:
    """Print the tables of one run and, unless the log just said so, why a figure is missing."""
    rows = store.rows(report=lambda unreadable: None)  # `steerbench results` tells of those
    rows = rows[rows["run"] == run]
    what = rows.iloc[0][["method", "scene", "trajectory", "resolution", "budget", "protocol"]]
    out = console()
    out.print(f"{', '.join(what)}, seed {rows.iloc[0]['seed']}: run {run}", style="bold")
    out.print(Columns([rich_table(table) for table in blocks(rows)]))
    missing: Any = store.record(run)["missing"] if explain else {}
    for metric, reason in missing.items():
        out.print(f"{metric}: n/a. {reason}", markup=False, soft_wrap=True)
