"""What identifies a run: its settings, its scene, the code that computes it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.errors import SteerbenchError
from bench.provenance import computed_by
from bench.results import content_key
from bench.run import measure
from bench.trajectories import Trajectory
from bench.types import Method, Scene
from sweeps.build import target_of

PLACES = ("outputs", "report", "tracker", "weights_dir")
"""Settings that are only locations and do not change a row."""


def described(config: DictConfig) -> dict[str, Any]:
    """The settings that determine a run; equal for equal jobs.

    Left out are: locations, except the last part of a scene's folder, which rows show; `split`,
    which is in the trajectory; the engine, if the method uses none; and what only the tables read.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:  # a setting that others use was removed
        raise SteerbenchError(" ".join(str(error).split())) from error
    unused = () if "engine" in plain["method"] else ("engine", "precision")
    left_out = ("split", "tables", *PLACES, *unused)
    kept = {key: value for key, value in plain.items() if key not in left_out}
    kept["scene"] = {name: value for name, value in plain["scene"].items() if name != "root"}
    if "path" in kept["scene"]:
        kept["scene"]["path"] = Path(kept["scene"]["path"]).name
    return kept


def job_key(settings: Mapping[str, Any], turns: str) -> str:
    """Equal for jobs with the same `settings` (see `described`) and the same `turns`."""
    return content_key({"settings": settings, "turns": turns} if turns else settings)


def run_parts(
    config: DictConfig, scene: Scene, method: Method, trajectory: Trajectory
) -> dict[str, Any]:
    """The parts of a run's key: everything that can change its rows, except the LPIPS weights."""
    settings = described(config)
    things = [measure, *_targets(settings)]
    files = (*getattr(method, "reads", ()), *trajectory.reads)
    read = [file for file in files if file.is_file()]
    return {
        "config": settings,
        "scene": scene.digest,
        "resolved": method.settings(),
        "files": [hashlib.sha256(file.read_bytes()).hexdigest() for file in read],
        **computed_by(*things),
    }


def _targets(node: Any) -> Iterator[Any]:
    """The classes and functions named by the `_target_` of `node` and all nodes below it."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield target_of(node)
        for value in node.values():
            yield from _targets(value)
