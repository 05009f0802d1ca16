"""Runs jobs where Hydra's launcher puts them: in this process, in others, or on other machines.

Jobs in other processes share with this one only the store, and the folder in which they record how
they ended.
"""

import json
import os
import sys
import time
import uuid
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import as_completed
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import InstantiationException
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, flag_override, open_dict

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable, explained
from bench.results import content_key
from bench.sharing import whole
from bench.study import study_of
from reports.runs import load_runs
from reports.tables import decimal
from sweeps.configured import trained, training_threads
from sweeps.measurement import Job, JobFailed, obtain, reason, stored
from sweeps.overrides import CONFIGS, composed, explain, setting, target_of
from sweeps.processes import on_gpu, processes, set_up
from sweeps.terminal import time_left

OF_MEASUREMENT = ("engine", "precision", "protocol", "pictures", "exclusive")
"""Settings of run.yaml that no training depends on."""

Group = list[tuple[int, Job]]
"""Jobs that are measured together, each with its number among all."""

W = TypeVar("W")
R = TypeVar("R")


# Where work is done


@dataclass(frozen=True)
class Launcher:
    """Where work is done.

    `words` are the settings of Hydra among those of a command (`hydra/launcher=joblib`), and the
    folders with further choices. Notes on the work go below `outputs`, the folder of the store.
    """

    words: Sequence[str]
    outputs: Path

    @property
    def in_process(self) -> bool:
        """Whether the work is done by this process, one piece after the other."""
        return self._config().hydra.runtime.choices["hydra/launcher"] == "basic"

    def run(self, work: Callable[[W], R], on: Sequence[W]) -> list[R]:
        """The results of `work` on each of the things in `on`.

        Raises what `work` raised first, once all is done; SteerbenchError if a setting of the
        launcher is wrong.
        """
        if not on:
            return []
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            loader = GlobalHydra.instance().config_loader()
        config = self._config()
        own_folder(config)
        join_cluster(config)
        try:
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=HydraContext(config_loader=loader, callbacks=Callbacks()),
                task_function=partial(_numbered, work, on),
                config=config,
            )
        except InstantiationException as error:
            raise explain(error, self.words) from error
        jobs = launcher.launch([[] for _ in on], initial_job_idx=0)
        results = [job.return_value for job in jobs]
        for result in results:
            if isinstance(result, Exception):
                raise result
        return results

    def _config(self) -> DictConfig:
        words = [*self.words, setting("outputs", str(self.outputs))]
        return composed(words, return_hydra_config=True)


def own_folder(config: DictConfig) -> Path:
    """Give the sweep a folder that no other has, for how its jobs end; it is below that in `config`
    and takes its place, also in the configurations of the jobs."""
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{uuid.uuid4().hex[:6]}"
    folder = Path(config.hydra.sweep.dir).resolve() / name
    with flag_override(config, ["readonly", "struct"], False):
        config.hydra.sweep.dir = str(folder)
        config.hydra.overrides.hydra.append(setting("hydra.sweep.dir", str(folder)))
    return folder


def join_cluster(config: DictConfig) -> None:
    """Let Ray's launcher join the cluster at the address in `config`, if there is one.

    It would ask for memory of its own, which a cluster that exists already refuses.
    """
    init = OmegaConf.select(config, "hydra.launcher.ray.init")
    if init and init.get("address"):
        with open_dict(init):
            init.setdefault("object_store_memory", None)


def divided(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The settings of runs among `words`, and those of Hydra."""
    of_hydra = [word for word in words if word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    return [word for word in words if word not in of_hydra], of_hydra


def _numbered(work: Callable[[W], R], on: Sequence[W], config: Any) -> R | Exception:
    """The task of a launcher's job: the job's number says what it works on.

    An exception is returned, because Hydra would print it in its own way.
    """
    set_up()
    try:
        return work(on[HydraConfig.get().job.num])
    except Exception as error:
        return error


# How jobs end


@dataclass(frozen=True)
class Ended:
    """How a job ended: with the key of its `run`, or with a `failure`.

    A run was `measured` unless the store had it. `number` counts from 0, in the order of the
    sweep. `outputs` is the folder with its store, `report` that of its page. `begun` is in seconds
    since the epoch.
    """

    number: int
    name: str
    outputs: str
    report: str | None
    begun: float
    measured: bool = False
    run: str | None = None
    failure: str | None = None

    def write(self, folder: Path) -> None:
        """Write the record to `folder`, atomically."""
        with explained(folder), whole(folder / f"{self.number}.job.json") as new:
            new.write_text(json.dumps(asdict(self), indent=1) + "\n", encoding="utf-8")


def read(folder: Path) -> list[Ended]:
    """Read the records of all jobs that have ended, in the order of the sweep."""
    texts = (path.read_text(encoding="utf-8") for path in folder.glob("*.job.json"))
    return sorted((Ended(**json.loads(text)) for text in texts), key=lambda job: job.number)


def attempt(numbered: Group, total: int, folder: Path) -> list[Exception]:
    """Obtain the runs of jobs that are measured together; print, and record in `folder`, how each
    ended.

    Each job has its number in the sweep; `total` is how many jobs that has; 0: not known. A job
    that fails is left out, and the others are measured without it. Returns the errors; they are
    printed, and kept for reports.
    """
    begun, errors = time.time(), []

    def end(number: int, job: Job, **how: Any) -> None:
        outputs = str(job.config.outputs)
        Ended(number, job.name, outputs, job.config.report, begun, **how).write(folder)

    left = list(numbered)
    while left:
        try:
            runs, measured = obtain([job for _, job in left])
        except Exception as error:
            alone = error.job if isinstance(error, JobFailed) else None
            cause = error.__cause__ if alone and isinstance(error.__cause__, Exception) else error
            errors.append(cause)
            for number, job in left:
                if alone is None or job is alone:
                    print(f"steerbench: failed: {job.name}: {cause}", file=sys.stderr)
                    with _printed():
                        job.keep_failure(reason(cause))
                    with _printed():
                        end(number, job, failure=reason(cause))
            left = [each for each in left if alone and each[1] is not alone]
        else:
            for (number, job), run in zip(left, runs, strict=True):
                end(number, job, run=run, measured=measured)
            for (_, job), run in zip(left, runs, strict=True):
                say(job, run, _progress(folder, total))
            return errors
    return errors


@contextmanager
def _printed() -> Iterator[None]:
    """Print an error of the body and go on, so that it does not hide the failure being recorded."""
    try:
        yield
    except Exception as error:
        print(f"steerbench: {reason(error)}", file=sys.stderr)


def say(job: Job, run: str, more: str = "") -> None:
    """Print the figures of a job's run in one line, and `more` after them."""
    (loaded,) = load_runs(job.store, [run])
    psnr, ms = decimal(loaded.values.get("psnr"), 2), decimal(loaded.values["frame_ms"], 1)
    print(f"{job.name}: {psnr} dB, {ms} ms a frame{more}", file=sys.stderr)


def _progress(folder: Path, total: int) -> str:
    """How many jobs are done, and an estimate of the remaining time from the measured ones."""
    ended = read(folder)
    if len(ended) > total:
        return ""
    seconds = time.time() - min(job.begun for job in ended)
    measured = sum(job.measured for job in ended)
    left = time_left(seconds, measured, total - len(ended))
    return f"; {len(ended)} of {total} jobs done{left}"


# All jobs of a command


def run_jobs(jobs: Sequence[Job], launcher: Launcher) -> int:
    """Run the jobs, equal ones only once; return how many of those that can run here failed.

    Goes scene by scene, and measures what has the first seed, then what has the next. Where there
    is room in this process, the models that the store lacks are trained before, in parallel;
    otherwise each job trains what it needs.
    """
    distinct = {job.key: job for job in reversed(jobs)}
    jobs = [job for job in jobs if distinct[job.key] is job]
    scenes, seeds = [job.scene for job in jobs], [job.config.seed for job in jobs]
    jobs.sort(key=lambda job: (scenes.index(job.scene), seeds.index(job.config.seed)))
    ahead, failed = launcher.in_process and room(jobs[0].config) > 1, 0
    of_scenes = [list(some) for _, some in groupby(jobs, lambda job: job.scene)]
    for some in of_scenes if ahead else [jobs]:
        groups, measured = _groups(some, look_up=ahead)
        if ahead:
            train_ahead(some, measured)
        total = sum(map(len, groups))
        failed += sum(launcher.run(partial(_attempted, total=total), groups))
    return failed


def _groups(jobs: Sequence[Job], look_up: bool) -> tuple[list[Group], set[str]]:
    """The jobs that are measured in turns, together.

    With `look_up`, without those that the store has; and the keys of these.
    """
    by_turns: dict[str, list[Job]] = {}
    for job in jobs:
        by_turns.setdefault(job.turns or job.key, []).append(job)
    groups: list[Group] = []
    measured: set[str] = set()
    for together in by_turns.values():
        found: dict[str, Job] = {}
        with suppress(SteerbenchError):  # a job that cannot start says so when it is measured
            found = stored(together) if look_up else {}
        for run, job in found.items():
            say(job, run)
        known = {job.key for job in found.values()}
        if left := [job for job in together if job.key not in known]:
            groups.append(list(enumerate(left, sum(map(len, groups)))))
        measured |= known
    return groups, measured


def _attempted(group: Group, total: int) -> int:
    """Attempt jobs that are measured together; return how many failed that can run here."""
    for number, job in group:
        print(f"{number + 1} of {total}, {job.name}", file=sys.stderr)
    errors = attempt(group, total, Path(HydraConfig.get().runtime.output_dir))
    return sum(not isinstance(error, Unavailable) for error in errors)


# Trainings in parallel, because small ones gain little from a second core


def train_ahead(jobs: Sequence[Job], measured: Collection[str]) -> None:
    """Train the models of `jobs`, which share one budget, as many at a time as the cores allow.

    Trainings of jobs whose key is in `measured` are skipped. The jobs load the stored stages when
    they are measured. A training that fails here fails again then, and is reported then.
    """
    todo: dict[str, Job] = {}
    for job in jobs:
        todo.setdefault(_training(job), job)
    for job in jobs:
        if job.key in measured:
            todo.pop(_training(job), None)
    if len(todo) < 2:
        return
    workers, log = room(jobs[0].config), ConsoleLog(jobs[0].outputs)
    log.info(f"training {len(todo)} models, {workers} at a time")
    begun = time.monotonic()
    with processes(workers) as pool:
        names = {pool.submit(_train, job.config): job.name for job in todo.values()}
        for number, ended in enumerate(as_completed(names), 1):
            left = time_left(time.monotonic() - begun, number, len(todo) - number)
            error = ended.exception()
            how = f"failed: {reason(error)}" if error else f"trained in {ended.result():.0f} s"
            print(f"{how}: {names[ended]}{left}", file=sys.stderr)


def room(config: DictConfig) -> int:
    """How many trainings can run at a time; 1 on a GPU, or if nothing sets their threads."""
    cores = len(os.sched_getaffinity(0))
    return 1 if on_gpu(config.device) else cores // training_threads(config)


def _training(job: Job) -> str:
    """A key of all settings that a training may depend on; equal for jobs that share it."""
    method = job.settings["method"]
    left_out = {*OF_MEASUREMENT, "method"}
    chosen = study_of(target_of(method)).chosen
    others = {name: value for name, value in job.settings.items() if name not in left_out}
    own = {name: value for name, value in method.items() if name not in chosen}
    return content_key({**others, "method": own})


def _train(config: DictConfig) -> float:
    """Train, or load the training, in a worker process; return the seconds it took."""
    log, quiet = (ConsoleLog(Path(config.outputs), quiet=each) for each in (False, True))
    quiet.followers = log.followers
    return trained(config, log, progress=quiet).train_s
