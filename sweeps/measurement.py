"""Jobs: what identifies them, and their runs, which are found in the store or measured now."""

import json
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable, explained, reason, some, unexpected
from bench.isolation import Guard, as_begun, put_back
from bench.kinds import Words
from bench.measure import MethodFailed, Task, measure, train
from bench.neighbours import Neighbours
from bench.provenance import (
    check_unchanged,
    computed_by,
    conditions_apart,
    left_behind,
    repositories,
    sums_of,
)
from bench.records import made, read_record
from bench.results import Store, content_key
from bench.sharing import whole
from bench.trajectories import Trajectory, resized
from bench.types import DEVICE, Log, Method, Scene
from reports.runs import Run, flat
from sweeps.configured import (
    as_declared,
    build,
    checked_settings,
    forget_scene,
    protocol_of,
    scene_digest,
    scene_folder,
    scene_of,
    training_threads,
    trajectory_of,
    use_threads,
)
from sweeps.experiments import axes
from sweeps.overrides import target_of
from sweeps.processes import device_lock

PLACES = ("outputs", "report", "weights_dir", "store")
"""Settings that say where things are, and whether to measure, but change no row."""

ABSOLUTE = re.compile(r"""(?<![^\s=,'"\[])~?/(?:[^\s,'"\]]*/)?([^/\s,'"\]]+)/*""")
portable = partial(ABSOLUTE.sub, r"\1")  # leaves of absolute paths the last part

AUTOMATIC = {"device": DEVICE, "backend": re.compile("reference|cpu|gpu")}
"""Settings that may be "auto", and what they can become in a key."""


def described(config: DictConfig) -> dict[str, Any]:
    """The settings that determine a run; equal for equal jobs.

    Left out are: locations, except the last part of a scene's folder, which rows show; `split`,
    which is in the trajectory; the engine, if the method uses none; what only the tables read;
    whether a sweep is measured in turns, which is in `Job.turns`; and `exclusive`, unless false.
    """
    try:
        plain: Any = OmegaConf.to_container(config, resolve=True)
    except OmegaConfBaseException as error:  # a setting that others use was removed
        raise SteerbenchError(reason(error)) from error
    unused = ["exclusive"] if plain.get("exclusive") is True else []
    unused += [] if "engine" in plain["method"] else ["engine", "precision"]
    left_out = ("split", "tables", "in_turns", *PLACES, *unused)
    kept = {key: as_declared(value) for key, value in plain.items() if key not in left_out}
    for group, place in (("scene", "root"), ("method", "folders")):
        kept[group] = {name: value for name, value in plain[group].items() if name != place}
    if "path" in kept["scene"]:
        kept["scene"]["path"] = Path(kept["scene"]["path"]).name
    return kept


def job_key(settings: Mapping[str, Any], turns: str) -> str:
    """Equal for jobs with the same `settings` (see `described`) and the same `turns`; raises
    SteerbenchError if a number is infinite or NaN."""
    try:
        return content_key({"settings": settings, "turns": turns} if turns else settings)
    except ValueError as error:
        raise unexpected("settings", "finite numbers", error) from error


def turns_of(name: str, config: DictConfig) -> str:
    """The `turns` of jobs of the sweep `name` that share scene and seed."""
    scene = Path(config.scene.get("path") or config.scene.get("name", "")).name
    return f"{name}, {config.seed}, {scene}"


def own_words(command: str) -> list[str]:
    """What determines a run among the words of its `command`."""
    words = map(portable, shlex.split(command)[1:])
    return [word for word in words if word.partition("=")[0] not in (*PLACES, "hydra.mode")]


@dataclass(frozen=True)
class Job:
    """A run that is wanted. Jobs with the same `turns` are measured in turns: they share scene,
    trajectory, protocol and seed; a job without `turns` is measured alone."""

    config: DictConfig  # the composed run.yaml
    command: Words  # the words that make it alone, for the record
    name: str = ""  # at the terminal
    turns: str = ""

    @cached_property
    def settings(self) -> dict[str, Any]:
        return described(self.config)

    @cached_property
    def key(self) -> str:
        return job_key(self.settings, self.turns)

    @property
    def outputs(self) -> Path:
        return Path(self.config.outputs)

    @property
    def store(self) -> Store:
        """Where its run is, or will be."""
        return Store(self.outputs)

    @property
    def failure_file(self) -> Path:
        """Holds why the job failed, until it succeeds."""
        return self.outputs / "failures" / f"{self.key[:16]}.json"

    @property
    def failure(self) -> "Failure | None":
        """How it failed in its last attempt; None if it did not."""
        file = self.failure_file
        return made(Failure, read_record(file), str(file)) if file.exists() else None

    def keep_failure(self, error: BaseException) -> None:
        """Record why it failed, for reports and gates: no earlier run stands for it."""
        why = reason(error).encode("utf-8", "backslashreplace").decode()  # of odd names of files
        missing = isinstance(error, Unavailable)
        held = Failure(why, shlex.join(self.command), self.key, missing)
        with explained(self.failure_file.parent):
            self.failure_file.parent.mkdir(parents=True, exist_ok=True)
            with whole(self.failure_file) as new:
                new.write_text(json.dumps(asdict(held), indent=1) + "\n", encoding="utf-8")

    def forget_failures(self) -> None:
        """Forget how it failed, and how its command failed when it had other defaults."""
        own = sorted(own_words(shlex.join(self.command)))
        for file, failure in failures(self.outputs).items():
            same = own and sorted(own_words(failure.command)) == own
            if same or failure.job == self.key:
                file.unlink(missing_ok=True)


Jobs = Sequence[Job]


@dataclass(frozen=True)
class Failure:
    """Why the last attempt of a job failed, which the `command` makes alone."""

    why: str
    command: str
    job: str  # its key
    unavailable: bool  # it needs what this machine lacks


def failures(outputs: Path) -> dict[Path, Failure]:
    """The last attempts of jobs that failed, by their files."""
    files = sorted(outputs.glob("failures/*.json"))
    return {file: made(Failure, read_record(file), str(file)) for file in files}


class JobFailed(SteerbenchError):
    """One of several jobs failed, `job`; its error is the cause."""

    def __init__(self, job: Job) -> None:
        super().__init__(f"failed: {job.name}")
        self.job = job


class NotStored(SteerbenchError):
    """A run that is not in the store, where nothing may be measured (store=only)."""


def obtain(jobs: Jobs) -> tuple[list[str], bool]:
    """The keys of the runs of `jobs`, whose `turns` are equal, and whether they are measured now.

    They are measured unless the store has all of them: figures that are compared come from the same
    hour. The setting `store` may have them measured always, or raise NotStored instead. Earlier
    failures are forgotten, new ones kept. Raises JobFailed if one of several jobs fails, for
    whatever reason: the others can then be obtained without it.
    """
    log = ConsoleLog(jobs[0].outputs)
    try:
        with as_begun():
            return _obtained(jobs, log)
    except Exception as error:
        forget_scene()  # a method may have spoilt it
        if not isinstance(error, NotStored):
            _keep_failure(jobs, error)
        raise


def _keep_failure(jobs: Jobs, error: Exception) -> None:
    failed, cause = jobs, error
    if isinstance(error, JobFailed) and isinstance(error.__cause__, Exception):
        failed, cause = [error.job], error.__cause__
    for job in failed:
        with suppress(Exception):  # nothing hides the failure itself
            job.keep_failure(cause)


def _obtained(jobs: Jobs, log: ConsoleLog) -> tuple[list[str], bool]:
    ready, policy = _ready(jobs, log), jobs[0].config.get("store")
    measured = policy == "always" or not _stored(ready)
    if measured and policy == "only":
        raise NotStored(
            f"{jobs[0].name or 'this run'}: not in {jobs[0].store.folder}, as this code and these "
            "files would measure it; store=missing measures it"
        )
    if measured:
        with _turn(ready, log, training_threads(jobs[0].config)):
            guard = train([each.method for each in ready], ready[0].task, log)
        with _turn(ready, log):
            # By another process meanwhile?
            measured = policy == "always" or not _stored(ready)
            if measured:
                _measure(ready, guard, log)
    return _told(ready, measured, log), measured


def stored(jobs: Jobs) -> dict[str, Job]:
    """Those of `jobs` that can be used here, by the keys that `obtain` would find in the store, if
    it has all of them and they need not be measured again; otherwise none."""
    log, left = ConsoleLog(jobs[0].outputs), list(jobs)
    while jobs[0].config.get("store") != "always":
        try:
            ready = _ready(left, log)
        except JobFailed as failed:
            left = [job for job in left if job is not failed.job]
        else:
            return dict(zip(_told(ready, False, log), left, strict=True)) if _stored(ready) else {}
    return {}


@dataclass(frozen=True, eq=False)
class _Ready:
    """A job ready to be measured; `parts` is everything that can change its rows."""

    job: Job
    method: Method
    task: Task
    parts: Mapping[str, Any]
    loaded: frozenset[str]  # the names of all modules before
    left: Sequence[str]  # what runs before it have left in modules of others

    def check_unchanged(self) -> None:
        """Raise SteerbenchError if its figures may be of other code or files than `parts` hold."""
        check_unchanged(self.loaded, measure, *targets(self.job.settings))
        settings = self.job.settings
        if self.parts["files"] != _read_by(self.method, self.task.trajectory, settings):
            raise SteerbenchError(
                f"a file that {self.method.name} or its path reads was changed meanwhile: run again"
            )

    @cached_property
    def run(self) -> str:
        """Its key in the store."""
        return self.job.store.key(self.parts)


def _ready(jobs: Jobs, log: Log) -> list[_Ready]:
    """The `jobs`, ready to be measured.

    With `turns`, each key includes the keys of all of them: if one job changes, all are measured
    again. Where pictures are compared with those of the first, nothing is measured without it.
    """
    ready: list[_Ready] = []
    for job in jobs:
        try:
            ready.append(_prepared(job, log))
        except Exception as error:
            if len(jobs) == 1 or _needed(job, jobs):
                raise
            raise JobFailed(job) from error
    if not jobs[0].turns:
        return ready
    if any(each.task.budget != ready[0].task.budget for each in ready):
        raise SteerbenchError("budget: expected the same for all that is measured in turns")
    keys = [content_key(each.parts) for each in ready]
    shared: dict[str, Any] = {"beside": sorted(keys)}
    if ready[0].task.protocol.compared:
        shared["compared_with"] = keys[0]
    return [replace(each, parts={**each.parts, **shared}) for each in ready]


def _needed(job: Job, jobs: Jobs) -> bool:
    """Whether the pictures of all `jobs` are compared with those of `job`."""
    return job is jobs[0] and bool(job.config.protocol.get("compared"))


def _prepared(job: Job, log: Log) -> _Ready:
    loaded = frozenset(sys.modules)
    config = job.config
    settings = checked_settings(config)
    use_threads(settings)
    torch.manual_seed(settings.seed)
    left = left_behind(*targets(job.settings))
    with put_back():
        method = build(config, "method")
    budget = build(config, "budget")
    protocol = protocol_of(config)
    scene = scene_of(config)
    trajectory = trajectory_of(config, scene, log)
    if settings.frame_size:
        trajectory = resized(trajectory, *settings.frame_size)
    weights = Path(settings.weights_dir) if settings.weights_dir else None
    scored = scene.splits.get(trajectory.split)
    parts = {
        "config": became(job.settings, method, scene),
        "scene": scene.digest,
        "names": content_key({"names": list(scored.names if scored else ())}),
        "resolved": method.settings(),
        "files": _read_by(method, trajectory, job.settings),
        **computed_by(measure, *targets(job.settings)),
        "lpips": protocol.find_lpips(weights, log),
        **({"turns": job.turns} if job.turns else {}),
    }
    task = Task(scene, trajectory, protocol, budget, settings.seed, weights, settings.pictures)
    return _Ready(job, method, task, parts, loaded, left)


def became(settings: Mapping[str, Any], method: Method, scene: Scene) -> dict[str, Any]:
    """`settings` with what "auto" stands for on this machine, and what `method` leaves to the scene
    as it is for this one: who types the same has the same run."""
    shown = method.settings()
    automatic = {
        name: shown[name] for name, form in AUTOMATIC.items() if form.fullmatch(shown[name])
    }
    decided: Mapping[str, Any] = {}
    if hasattr(method, "decided"):
        decided = method.decided(scene)

    def resolved(node: Mapping[str, Any], before: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in node.items():
            if isinstance(value, Mapping):
                found[name] = resolved(value, f"{before}{name}.")
            elif value == "auto":
                found[name] = automatic.get(name, value)
            else:
                found[name] = decided.get(f"{before}{name}", value)
        return found

    return resolved(settings, "")


def _read_by(method: Method, trajectory: Trajectory, settings: Mapping[str, Any]) -> list[str]:
    """The checksums of the files that a method and a path read, and of those whose names are
    settings of the method."""
    named = [Path(text) for _, text in flat(settings["method"]) if isinstance(text, str)]
    given = (*getattr(method, "reads", ()), *trajectory.reads)
    return sums_of((*given, *filter(_is_file, named)), f"{method.name}: its attribute reads")


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long for a name, or with a NUL
        return False


def targets(node: Any) -> Iterator[Any]:
    """The classes and functions named by the `_target_` of `node` and all nodes below it."""
    if isinstance(node, Mapping):
        if "_target_" in node:
            yield target_of(node)
        for value in node.values():
            yield from targets(value)


def _stored(ready: Sequence[_Ready]) -> bool:
    return all(each.job.store.intact(each.run) for each in ready)


def _told(ready: Sequence[_Ready], measured: bool, log: Log) -> list[str]:
    """Note that these runs stand for their jobs from now on, whose earlier failures are forgotten;
    their keys."""
    for each in ready:
        each.job.store.use(each.run, each.job.key)
        if not measured:
            record = each.job.store.record(each.run)
            log.info(f"already measured: {each.run}; store=always measures again")
            if apart := conditions_apart(record["machine"]):
                log.info(f"its times are of other conditions: {apart}")
            neighbours = Neighbours(**record["neighbours"])
            if neighbours.notable:
                log.info(f"{neighbours} while its frames were timed")
            for doubt in record.get("doubts", ()):
                log.info(f"{each.method.name}: {doubt}")
        each.job.forget_failures()
    return [each.run for each in ready]


@contextmanager
def _turn(ready: Sequence[_Ready], log: ConsoleLog, threads: int | None = None) -> Iterator[None]:
    """Hold the devices of all that are exclusive, see `device_lock`. A method that fails in the
    body fails its job."""
    devices = {each.method.settings()["device"] for each in ready if each.job.config.exclusive}
    try:
        with ExitStack() as turns:
            for device in sorted(devices):
                turns.enter_context(device_lock(device, log, threads))
            yield
    except MethodFailed as failed:
        (job,) = (each.job for each in ready if each.method is failed.method)
        if _needed(job, [each.job for each in ready]) and failed.__cause__:
            raise failed.__cause__ from None
        raise JobFailed(job) from failed.__cause__


def _measure(ready: Sequence[_Ready], guard: Guard, log: Log) -> None:
    """Measure all, and put them in the place of earlier ones, damaged ones, and what is left by an
    interruption."""
    methods = [each.method for each in ready]
    measurements = measure(methods, ready[0].task, log, guard)
    for each in ready:
        each.check_unchanged()
    for each in ready:
        each.job.store.remove(each.run)
    for each, measurement in zip(ready, measurements, strict=True):
        record: dict[str, Any] = {
            **measurement.record,
            "command": shlex.join(each.job.command),
            "scene_path": scene_folder(each.job.config),
            "axes": {axis.setting: name for name, axis in axes(each.method.name).items()},
            "repositories": repositories(*targets(each.job.settings)),
        }
        if each.left:
            doubt = (
                f"runs before it in this process have changed {some(each.left)}, which it may use: "
                "keep state in the method itself, or let each job have its process "
                "(hydra/launcher=joblib)"
            )
            record["doubts"] = [*record["doubts"], doubt]
            log.info(f"{each.method.name}: {doubt}")
        record["neighbours"] |= {"exclusive": each.job.config.exclusive}
        if each.task.protocol.compared:
            record["compared_with"] = ready[0].run
        each.job.store.save(each.parts, replace(measurement, record=record))


def of_scene(run: Run, config: DictConfig) -> bool:
    """Whether `run`, which has the settings of `config`, also has its scene.

    The settings do not tell apart folders with the same last name. If the folder does not exist
    here, only this name counts.
    """
    folder = scene_folder(config)
    if folder is None or run.record.get("scene_path") == folder or not Path(folder).is_dir():
        return True
    return run.digest == scene_digest(config)
