"""One measurement from its configuration: built, looked up in the store or made, shown."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.columns import Columns

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable
from bench.provenance import computed_by
from bench.results import Measurement, Store, content_key
from bench.run import Task, measure_in_turns
from bench.scenes.held_out import hold_out
from bench.trajectories import Trajectory
from bench.types import DEVICE, Log, Method, Scene
from reports.runs import Run, load
from reports.tables import run_tables
from reports.trackers import Tracker, tracker
from sweeps import failures
from sweeps.build import build, check_settings, target_of
from sweeps.device_lock import device_lock
from sweeps.overrides import VALIDATION
from sweeps.terminal import console, rich_table

PLACES = ("outputs", "report", "tracker", "weights_dir")
"""Settings that say where things lie: they do not change a row."""

HELD_OUT = 8
"""Of so many training pictures one is held out, where a trajectory goes to these."""

USUAL_THREADS = torch.get_num_threads()
"""How many threads torch uses by default."""


@dataclass(frozen=True)
class Settings:
    """The settings of a run that are no choices; run.yaml explains each of them."""

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


Asked = tuple[DictConfig, Sequence[str]]
"""The configuration of a measurement, and the command that asks for it."""


@dataclass(frozen=True)
class Obtained:
    """A run that is in the store; `measured` says whether it had to be measured for that."""

    store: Store
    run: str
    measured: bool


def execute(config: DictConfig, command: Sequence[str]) -> None:
    """Obtain the run that `config` describes, print its tables, write its page.

    Raises as `obtain` does, and where the page cannot be written.
    """
    obtained = obtain(config, command)
    label = {obtained.run: HydraConfig.get().runtime.choices["method"]}
    (run,) = load(obtained.store, label)
    _show(run, explain=not obtained.measured)
    if config.report:
        from reports.page import write_page  # and matplotlib, which only a page needs

        page = write_page(obtained.store, label, Path(config.report))
        ConsoleLog(Path(config.outputs)).info(f"report: {page}")


def obtain(config: DictConfig, command: Sequence[str]) -> Obtained:
    """Measure what `config` describes, unless the store has it; its failures are forgotten then.

    Args:
        config: the composed run.yaml.
        command: the words that were typed, for the record.

    Raises:
        SteerbenchError: a setting is wrong, or something in the measurement went wrong.
    """
    return obtain_in_turns([(config, command)])[0]


def obtain_in_turns(jobs: Sequence[Asked], turns: str = "") -> list[Obtained]:
    """`obtain` several jobs, which share scene, trajectory, protocol and seed, under the name
    `turns`: unless the store has all of them, they draw each frame one after the other, see
    `bench.run.measure_in_turns`. A job alone has no such name.

    Raises as `obtain` does.
    """
    log = ConsoleLog(Path(jobs[0][0].outputs))
    ready = _ready(jobs, turns, log)
    for one in ready:
        if one.stored:
            one.say_stored(log)
    missing = [one for one in ready if not one.stored]
    if missing:
        with device_lock(missing[0].method.settings()["device"], log):
            missing = [one for one in missing if not one.stored]  # by who had the lock before
            if missing:
                methods = [one.method for one in ready]
                found = measure_in_turns(methods, missing[0].task, log)
                for one, measurement in zip(ready, found, strict=True):
                    if one in missing:
                        one.keep(measurement)
    for config, _ in jobs:
        failures.forget(Path(config.outputs), described(config))
    for one in ready:
        if one.config.tracker:
            _send(one, tracker(one.config.tracker), log)
    measured = {one.run for one in missing}
    return [Obtained(one.store, one.run, one.run in measured) for one in ready]


def _send(one: _Ready, to: Tracker, log: Log) -> None:
    """Send a stored run to a tracker. What goes wrong there is said: the measurement stands."""
    try:
        to.send(load(one.store, {one.run: one.method.name})[0], Path(one.config.outputs))
        log.info(f"sent to {one.config.tracker}: {one.run}")
    except Exception as error:  # of a library that we do not know
        log.info(f"not sent to {one.config.tracker}: {one.run}: {failures.reason(error)}")


def stored(jobs: Sequence[Asked], turns: str = "") -> list[Obtained]:
    """What `obtain_in_turns` would find of these jobs in the store: all of them, or nothing.

    Raises as `obtain` does.
    """
    log = ConsoleLog(Path(jobs[0][0].outputs))
    ready = _ready(jobs, turns, log)
    if not all(one.stored for one in ready):
        return []
    for one in ready:
        one.say_stored(log)
        failures.forget(Path(one.config.outputs), described(one.config))
    return [Obtained(one.store, one.run, measured=False) for one in ready]


def trained(config: DictConfig, log: Log) -> Method:
    """The method that `config` describes, trained on its scene.

    Raises as `obtain` does.
    """
    torch.manual_seed(checked_settings(config).seed)
    method, budget = (build(config, name) for name in ("method", "budget"))
    method.fit(scene_of(config), budget, log)
    return method


@dataclass(frozen=True, eq=False)
class _Ready:
    """A measurement that can begin, and everything that can change its rows: its `parts`."""

    config: DictConfig
    command: Sequence[str]
    method: Method
    task: Task
    parts: Mapping[str, Any]
    store: Store

    @classmethod
    def of(cls, config: DictConfig, command: Sequence[str], turns: str, log: Log) -> _Ready:
        settings = checked_settings(config)
        torch.manual_seed(settings.seed)
        method, budget, protocol = (
            build(config, name) for name in ("method", "budget", "protocol")
        )
        scene = scene_of(config)
        trajectory = build(config, "trajectory", scene)
        weights = Path(settings.weights_dir) if settings.weights_dir else None
        parts = _identity(config, scene, method, trajectory) | {
            "lpips": protocol.find_lpips(weights, log)
        }
        parts |= {"turns": turns} if turns else {}
        task = Task(scene, trajectory, protocol, budget, settings.seed, weights, settings.pictures)
        return cls(config, command, method, task, parts, Store(Path(settings.outputs)))

    @cached_property
    def run(self) -> str:
        """Its key in the store."""
        return self.store.key(self.parts)

    @property
    def stored(self) -> bool:
        return self.store.find(self.run) is not None

    def say_stored(self, log: Log) -> None:
        log.info(f"already measured; to measure again, remove {self.store.folder / self.run}")

    def keep(self, measurement: Measurement) -> None:
        """Put it into the store, with where it comes from."""
        more = {"command": shlex.join(self.command), "scene_path": _folder(self.config)}
        record = {**measurement.record, **more}
        self.store.save(self.parts, replace(measurement, record=record))


def _ready(jobs: Sequence[Asked], turns: str, log: Log) -> list[_Ready]:
    """The measurements of `jobs`. The key of one in turns names those beside it: if one of them is
    new, all of them are, and no two lines of a table come from different hours."""
    ready = [_Ready.of(config, command, turns, log) for config, command in jobs]
    if not turns:
        return ready
    beside = sorted(content_key(one.parts) for one in ready)
    return [replace(one, parts={**one.parts, "beside": beside}) for one in ready]


def scene_of(config: DictConfig) -> Scene:
    """The scene that `config` describes. Where its trajectory is through training pictures that are
    held out, they are: what is trained on all of them is never scored on some of them.

    Raises:
        SteerbenchError: the scene cannot be loaded, or has too few training pictures.
    """
    return _divided(*_contents(config))


def _contents(config: DictConfig) -> tuple[str, Path, bool]:
    """The scene's node as YAML, the root of all outputs, and whether views are held out."""
    held_out = OmegaConf.select(config, "trajectory.split") == VALIDATION
    return OmegaConf.to_yaml(config.scene, resolve=True), Path(config.outputs), held_out


def _divided(node: str, root: Path, held_out: bool) -> Scene:
    scene = _scene(node, root)
    return hold_out(scene, VALIDATION, HELD_OUT) if held_out else scene


@lru_cache(maxsize=1)
def _scene(node: str, root: Path) -> Scene:
    """The scene that `node`, as YAML, describes, kept for the next job of a sweep."""
    return build(OmegaConf.create({"scene": OmegaConf.create(node)}), "scene", log=ConsoleLog(root))


def checked_settings(config: DictConfig) -> Settings:
    """The settings in `config`. From now on torch uses as many threads as they say.

    Raises:
        SteerbenchError: one of them is wrong.
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
    folder = _folder(config)
    if folder is None or run.record.get("scene_path") == folder or not Path(folder).is_dir():
        return True
    return run.record["scene"]["digest"] == _digest(*_contents(config))


@cache
def _digest(node: str, root: Path, held_out: bool) -> str:
    """The digest of a scene: kept, because to find it the whole scene is loaded."""
    return _divided(node, root, held_out).digest


def _folder(config: DictConfig) -> str | None:
    """Where the scene lies; None if it is embedded."""
    return str(Path(config.scene.path).resolve()) if "path" in config.scene else None


def _identity(
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


def _show(run: Run, explain: bool) -> None:
    """Print the tables of one run and, unless the log just said so, why a figure is missing."""
    what = run.facts[["method", "scene", "trajectory", "resolution", "budget", "protocol"]]
    out = console()
    out.print(f"{', '.join(what)}, seed {run.facts['seed']}: run {run.key}", style="bold")
    out.print(Columns([rich_table(table) for table in run_tables(run.rows)]))
    for metric, reason in run.record["missing"].items() if explain else ():
        out.print(f"{metric}: n/a. {reason}", markup=False, soft_wrap=True)
