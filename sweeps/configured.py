"""Makes what the configuration of a run describes: its settings, its scene, its trained method."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache, lru_cache
from pathlib import Path
from typing import Literal

import torch
from omegaconf import DictConfig, OmegaConf

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.scenes.assemble import hold_out
from bench.types import DEVICE, Log, Method, Scene
from reports.trackers import tracker
from sweeps.build import build, check_settings
from sweeps.overrides import VALIDATION

HELD_OUT = 8
"""One in this many training pictures is held out if a trajectory renders held-out pictures."""

USUAL_THREADS = torch.get_num_threads()
"""Number of threads that torch uses by default."""


@dataclass(frozen=True)
class Settings:
    """The settings of a run that are plain values; run.yaml explains each of them."""

    seed: int
    split: Literal["test", "validation"]
    device: str
    backend: str
    threads: int | None
    pictures: int
    outputs: str
    weights_dir: str | None
    tracker: str | None
    report: str | None


def checked_settings(config: DictConfig) -> Settings:
    """The settings in `config`. Also sets torch's number of threads as they say.

    Raises:
        SteerbenchError: a setting is wrong.
    """
    names = [field.name for field in fields(Settings)]
    if missing := [name for name in names if name not in config]:
        raise SteerbenchError(f"{missing[0]} is not set: give {missing[0]}=...")
    values = {name: config[name] for name in names}
    check_settings(Settings, values)
    settings = Settings(**values)
    if settings.seed < 0:
        raise SteerbenchError(f"seed: expected 0 or more, got {settings.seed}")
    if settings.threads is not None and settings.threads < 1:
        raise SteerbenchError(f"threads: expected 1 or more, or null, got {settings.threads}")
    if settings.pictures < 0:
        raise SteerbenchError(f"pictures: expected 0 or more, got {settings.pictures}")
    if settings.tracker is not None:
        tracker(settings.tracker)
    if not DEVICE.fullmatch(settings.device):
        raise SteerbenchError(f"device: expected auto, cpu, cuda or cuda:N, got {settings.device}")
    _, _, number = settings.device.partition(":")
    if settings.device.startswith("cuda") and int(number or 0) >= torch.cuda.device_count():
        raise Unavailable(
            f"device={settings.device}: torch sees {torch.cuda.device_count() or 'no'} GPUs here, "
            "numbered from 0; use another, or device=cpu"
        )
    torch.set_num_threads(settings.threads or USUAL_THREADS)
    return settings


def trained(config: DictConfig, log: Log) -> Method:
    """The method that `config` describes, trained on its scene.

    Raises:
        SteerbenchError: a setting is wrong, or something in the training went wrong.
    """
    torch.manual_seed(checked_settings(config).seed)
    method, budget = (build(config, name) for name in ("method", "budget"))
    method.fit(scene_of(config), budget, log)
    return method


def scene_of(config: DictConfig) -> Scene:
    """The scene that `config` describes.

    If its trajectory renders held-out training pictures, these are removed from the training split,
    so that a model is never scored on pictures that it was trained on.

    Raises:
        SteerbenchError: the scene cannot be loaded, or has too few training pictures.
    """
    return _divided(*_contents(config))


def scene_digest(config: DictConfig) -> str:
    """The digest of the scene that `config` describes; raises as `scene_of` does."""
    return _digest(*_contents(config))


def scene_folder(config: DictConfig) -> str | None:
    """The folder of the scene; None for an embedded scene."""
    return str(Path(config.scene.path).expanduser().resolve()) if "path" in config.scene else None


def _contents(config: DictConfig) -> tuple[str, Path, bool]:
    """The scene's node as YAML, the root of all outputs, and whether views are held out."""
    held_out = OmegaConf.select(config, "trajectory.split") == VALIDATION
    return OmegaConf.to_yaml(config.scene, resolve=True), Path(config.outputs), held_out


@cache
def _digest(node: str, root: Path, held_out: bool) -> str:
    """Cached, because it takes loading the whole scene."""
    return _divided(node, root, held_out).digest


def _divided(node: str, root: Path, held_out: bool) -> Scene:
    scene = _scene(node, root)
    return hold_out(scene, VALIDATION, HELD_OUT) if held_out else scene


@lru_cache(maxsize=1)
def _scene(node: str, root: Path) -> Scene:
    """The scene described by `node` (YAML), cached for the next job of a sweep."""
    return build(OmegaConf.create({"scene": OmegaConf.create(node)}), "scene", log=ConsoleLog(root))
