"""Runs jobs where Hydra's launcher puts them: in this process, in others, or on other machines.

Jobs in other processes share with this one only the store, and a folder in which they count.
"""

import os
import pickle
import time
import uuid
from collections.abc import Collection, Sequence
from concurrent.futures import as_completed
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

from hydra import initialize_config_dir
from hydra._internal.callbacks import Callbacks
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.errors import InstantiationException
from hydra.types import HydraContext
from omegaconf import DictConfig, OmegaConf, flag_override, open_dict

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable, reason
from bench.kinds import Words
from bench.records import without
from bench.results import content_key
from bench.study import study_of
from reports.runs import grouped, load_runs
from reports.tables import decimal
from sweeps.configured import scene_folder, trained, training_threads
from sweeps.measurement import Job, JobFailed, Jobs, obtain, stored
from sweeps.overrides import CONFIGS, composed, explain, folder_words, setting, target_of
from sweeps.processes import on_gpu, processes, set_up
from sweeps.terminal import note, time_left

OF_MEASUREMENT = ("engine", "precision", "protocol", "pictures", "exclusive")
"""Settings of run.yaml that no training depends on."""

OF_METHOD = ("method", "engine", "precision")
"""Settings in which jobs may differ that are measured in turns."""

Group = list[tuple[int, Job]]  # jobs that are measured together, each with its number among all


@dataclass(frozen=True)
class Ended:
    """How a job ended: with the key of its `run`, which was `measured` unless the store had it, or
    with an `error`."""

    run: str | None = None
    measured: bool = False
    error: Exception | None = None

    @property
    def failed(self) -> bool:
        """Whether it failed, and can run here."""
        return self.error is not None and not isinstance(self.error, Unavailable)

    def __reduce__(self) -> tuple[Any, ...]:
        return Ended, (self.run, self.measured, self.error and picklable(self.error))


Endings = dict[str, Ended]  # by the keys of jobs


@dataclass(frozen=True)
class Launcher:
    """Where work is done, as Hydra's `config` says; errors quote the `words` of the command."""

    config: DictConfig
    words: Words

    def run(self, groups: Sequence[Group]) -> list[Endings]:
        """How the jobs of each group ended, by their keys.

        Raises what was raised first beside them, once all is done; SteerbenchError if a setting of
        the launcher is wrong.
        """
        if not groups:
            return []
        with initialize_config_dir(str(CONFIGS), version_base="1.3"):
            loader = GlobalHydra.instance().config_loader()
        config = self.config.copy()
        own_folder(config)
        ray = OmegaConf.select(config, "hydra.launcher.ray.init")
        # Ray's launcher would ask for memory of its own, which a cluster at an address refuses.
        if ray and ray.get("address"):
            with open_dict(ray):
                ray.setdefault("object_store_memory", None)
        try:
            launcher = Plugins.instance().instantiate_launcher(
                hydra_context=HydraContext(config_loader=loader, callbacks=Callbacks()),
                task_function=partial(_measured, groups, time.time()),
                config=config,
            )
        except InstantiationException as error:
            raise explain(error, self.words) from error
        jobs = launcher.launch([[] for _ in groups], initial_job_idx=0)
        results = [job.return_value for job in jobs]
        for result in results:
            if isinstance(result, Exception):
                raise result
        return results


def own_folder(config: DictConfig) -> None:
    """Give the sweep a folder that no other has; it is below that in `config` and takes its place,
    also in the configurations of the jobs."""
    name = f"{datetime.now():%Y-%m-%d_%H-%M-%S}-{uuid.uuid4().hex[:6]}"
    folder = Path(config.hydra.sweep.dir).resolve() / name
    with flag_override(config, ["readonly", "struct"], False):
        config.hydra.sweep.dir = str(folder)
        config.hydra.overrides.hydra.append(setting("hydra.sweep.dir", str(folder)))


def divided(words: Words) -> tuple[list[str], list[str]]:
    """The settings of runs among `words`, and those of Hydra."""
    of_hydra = [word for word in words if word.lstrip("+~").startswith(("hydra.", "hydra/"))]
    return [word for word in words if word not in of_hydra], of_hydra


def _measured(groups: Sequence[Group], begun: float, config: DictConfig) -> Endings | Exception:
    """The task of a launcher's job, whose number says which of the `groups` it measures. An
    exception is returned, because Hydra would print it in its own way."""
    set_up()
    hydra, total = HydraConfig.get(), sum(map(len, groups))
    try:
        for number, job in groups[hydra.job.num]:
            note(f"{number + 1} of {total}, {job.name}")
        return attempt(groups[hydra.job.num], total, Path(hydra.runtime.output_dir), begun)
    except Exception as error:
        return picklable(error)


def picklable(error: Exception) -> Exception:
    """`error`, or only its message if another process could not read it."""
    try:
        pickle.loads(pickle.dumps(error))
        return error
    except Exception:
        return SteerbenchError(f"{type(error).__name__}: {reason(error)}")


def attempt(group: Group, total: int, folder: Path, begun: float) -> Endings:
    """Obtain the runs of jobs that are measured together; print how each ended, and return it by
    the key of the job.

    Each job has its number among `total`, which began at the time `begun`; all jobs count in
    `folder`. A job that fails is left out, and the others are measured without it. Its error is
    printed, and kept for reports.
    """
    ended: Endings = {}
    left = list(group)
    while left:
        try:
            runs, measured = obtain([job for _, job in left])
            for number, _ in left:
                _count(folder, number, measured)
            for (_, job), run in zip(left, runs, strict=True):
                ended[job.key] = Ended(run, measured)
                say(job, run, _progress(folder, total, begun))
            left = []
        except Exception as error:
            alone = error.job if isinstance(error, JobFailed) else None
            cause = error.__cause__ if alone and isinstance(error.__cause__, Exception) else error
            failed = [each for each in left if alone is None or each[1] is alone]
            for number, job in failed:
                note(f"steerbench: failed: {job.name}: {cause}")
                ended[job.key] = Ended(error=cause)
                _count(folder, number)
            left = [each for each in left if each not in failed]
    return ended


def say(job: Job, run: str, more: str = "") -> None:
    """Print the figures of a job's run in one line, and `more` after them."""
    (loaded,) = load_runs(job.store, [run])
    psnr, ms = decimal(loaded.values.get("psnr"), 2), decimal(loaded.values["frame_ms"], 1)
    note(f"{job.name}: {psnr} dB, {ms} ms a frame{more}")


def _count(folder: Path, number: int, measured: bool = False) -> None:
    with suppress(OSError):
        (folder / f"{number}.{'measured' if measured else 'ended'}").touch()


def _progress(folder: Path, total: int, begun: float) -> str:
    """How many jobs are done, and an estimate of the remaining time from the measured ones."""
    measured, others = (len([*folder.glob(f"*.{how}")]) for how in ("measured", "ended"))
    done = measured + others
    left = time_left(time.time() - begun, measured, total - done)
    return f"; {done} of {total} jobs done{left}"


def run_jobs(jobs: Jobs, launcher: Launcher) -> list[Ended]:
    """Run the jobs, equal ones only once, and say how each of them ended.

    Goes scene by scene, and measures what has the first seed, then what has the next. Where there
    is room in this process, the models that the store lacks are trained before, in parallel;
    otherwise each job trains what it needs.
    """
    first = {job.key: job for job in reversed(jobs)}
    for job in jobs:  # of a folder, a key has the last part
        if (one := scene_folder(first[job.key].config)) != (other := scene_folder(job.config)):
            raise SteerbenchError(f"scene.path: {one}, {other}: expected folders with other names")
    distinct = (job for job in jobs if first[job.key] is job)
    of_scenes = [
        list(chain(*grouped(of_scene, lambda job: job.settings["seed"]).values()))
        for of_scene in grouped(distinct, lambda job: str(job.settings["scene"])).values()
    ]
    in_process = launcher.config.hydra.runtime.choices["hydra/launcher"] == "basic"
    ahead, ended = in_process and room(jobs) > 1, dict[str, Ended]()
    for some in of_scenes if ahead else [[*chain(*of_scenes)]]:
        groups, found = _groups(some, look_up=ahead)
        if ahead:
            train_ahead(some, found)
        for of_group in (found, *launcher.run(groups)):
            ended |= of_group
    return [ended[job.key] for job in jobs]


def run_all(jobs: Jobs, words: Words) -> list[Ended]:
    """Run the jobs, see `run_jobs`, with the launcher that `words` of a command choose
    (`hydra/launcher=joblib`). Notes on the work go below the outputs of the jobs."""
    place = setting("outputs", str(jobs[0].outputs))
    words = [*folder_words(words), *divided(words)[1], place]
    return run_jobs(jobs, Launcher(composed(words, return_hydra_config=True), words))


def _groups(jobs: Jobs, look_up: bool) -> tuple[list[Group], Endings]:
    """The jobs that are measured together: of those with the same `turns`, what differs only in the
    method.

    With `look_up`, without those that the store has, which are returned as ended.
    """

    def together(job: Job) -> tuple[str, str]:
        shared = without(job.settings, OF_METHOD)
        return job.turns, content_key(shared) if job.turns else job.key

    groups: list[Group] = []
    ended: Endings = {}
    for of_group in grouped(jobs, together).values():
        found: dict[str, Job] = {}
        with suppress(SteerbenchError):  # a job that cannot start says so when it is measured
            found = stored(of_group) if look_up else {}
        for run, job in found.items():
            say(job, run)
            ended[job.key] = Ended(run)
        if left := [job for job in of_group if job.key not in ended]:
            groups.append(list(enumerate(left, sum(map(len, groups)))))
    return groups, ended


def train_ahead(jobs: Jobs, measured: Collection[str]) -> None:
    """Train the models of `jobs`, as many at a time as the cores allow: small trainings gain little
    from a second core.

    Trainings of jobs whose key is in `measured` are skipped. The jobs load the stored stages when
    they are measured. A training that fails here fails again then, and is reported then.
    """
    todo: dict[str, Job] = {}
    for job in sorted(jobs, key=lambda job: job.key not in measured):
        with suppress(SteerbenchError):  # it says so when it is measured
            todo.setdefault(_training(job), job)
    todo = {name: job for name, job in todo.items() if job.key not in measured}
    if len(todo) < 2 or jobs[0].config.get("store") == "only":
        return
    workers, log = room(jobs), ConsoleLog(jobs[0].outputs)
    log.info(f"training {len(todo)} models, {workers} at a time")
    begun = time.monotonic()
    with processes(workers) as pool:
        names = {pool.submit(_train, job.config): job.name for job in todo.values()}
        for number, ended in enumerate(as_completed(names), 1):
            left = time_left(time.monotonic() - begun, number, len(todo) - number)
            error = ended.exception()
            how = f"failed: {reason(error)}" if error else f"trained in {ended.result():.0f} s"
            note(f"{how}: {names[ended]}{left}")


def room(jobs: Jobs) -> int:
    """How many trainings can run at a time; 1 on a GPU, or if nothing sets their threads."""
    if any(on_gpu(job.config.device) for job in jobs):
        return 1
    try:
        return len(os.sched_getaffinity(0)) // max(training_threads(job.config) for job in jobs)
    except SteerbenchError:  # as a job that cannot start says when it is measured
        return 1


def _training(job: Job) -> str:
    """A key of all settings that a training may depend on; equal for jobs that share it."""
    method = job.settings["method"]
    chosen = study_of(target_of(method)).chosen
    others = without(job.settings, OF_MEASUREMENT)
    return content_key({**others, "method": without(method, chosen)})


def _train(config: DictConfig) -> float:
    """Train, or load the training, in a worker process; return the seconds it took."""
    log, quiet = (ConsoleLog(Path(config.outputs), quiet=each) for each in (False, True))
    quiet.followers = log.followers
    try:
        return trained(config, log, progress=quiet).train_s
    except Exception as error:
        raise picklable(error) from None
