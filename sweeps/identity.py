"""What makes a run the one it is: its settings, its scene, the code that computes it."""

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
from bench.run import measure_in_turns
from bench.trajectories import Trajectory
from bench.types import Method, Scene
from reports.runs import Run
from sweeps.build import target_of
from sweeps.configured import scene_digest, scene_folder

PLACES = ("outputs", "report", "tracker", "weights_dir")
"""Settings that say where things lie: they do not change a row."""


def described(config: DictConfig) -> dict[str, Any]:
    """The settings that decide a run; equal for equal jobs.

    Without the places of weights and scenes, except for the last name of a scene's folder, which
    rows show; without `split`, which the trajectory has, and `sizing`, which methods have; without
    the engine where the method uses none; and without what the budget says about other jobs.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:  # a setting was removed that others use
        raise SteerbenchError(" ".join(str(error).split())) from error
    unused = () if "engine" in plain["method"] else ("engine", "precision")
    left_out = ("split", "sizing", *PLACES, *unused)
    kept = {key: value for key, value in plain.items() if key not in left_out}
    of_sweep = ("seeds", "beyond")
    kept["budget"] = {key: value for key, value in plain["budget"].items() if key not in of_sweep}
    kept["scene"] = {name: value for name, value in plain["scene"].items() if name != "root"}
    if "path" in kept["scene"]:
        kept["scene"]["path"] = Path(kept["scene"]["path"]).name
    return kept


def job_key(settings: Mapping[str, Any], turns: str) -> str:
    """Equal for jobs with the same `settings`, as of `described`, measured in the same `turns`."""
    return content_key({"settings": settings, "turns": turns} if turns else settings)


def of_scene(run: Run, config: DictConfig) -> bool:
    """Whether `run`, which has the settings of `config`, shows this scene, and not another whose
    folder has the same last name. Of a folder that is not here only the name is compared."""
    folder = scene_folder(config)
    if folder is None or run.record.get("scene_path") == folder or not Path(folder).is_dir():
        return True
    return run.record["scene"]["digest"] == scene_digest(config)


def run_parts(
    config: DictConfig, scene: Scene, method: Method, trajectory: Trajectory
) -> dict[str, Any]:
    """Everything that can change the rows, except for the weights of LPIPS: a run's key."""
    settings = described(config)
    things = [measure_in_turns, *_targets(settings)]
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
    """The classes and functions that `node` and all nodes below it name."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield target_of(node)
        for value in node.values():
            yield from _targets(value)
