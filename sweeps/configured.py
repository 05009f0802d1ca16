"""Makes what the configuration of a run describes: its settings, its scene, its trained method.

All raise SteerbenchError, which names the setting, if one is wrong or cannot be had here.
"""

import inspect
import os
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import torch
from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from bench.console import ConsoleLog
from bench.errors import SteerbenchError, Unavailable, unexpected, unknown
from bench.isolation import as_begun, fit
from bench.protocol import EvaluationProtocol
from bench.provenance import Stamp, stamp
from bench.records import coerced, fits
from bench.scenes.assemble import hold_out
from bench.trajectories import Trajectory
from bench.types import DEVICE, Log, Method, Scene
from sweeps.overrides import CONFIGS, VALIDATION, target_of
from sweeps.processes import device_lock

STANDARD = "steerbench-1"  # the protocol of a run, if no other is asked for
OF_TIMING = ("warmup", "rounds", "stages", "waits", "compared")  # what changes no score

USUAL_THREADS = torch.get_num_threads()  # number of threads that torch uses by default


@dataclass(frozen=True)
class Settings:
    """The settings of a run that are plain values; run.yaml explains each of them."""

    seed: int
    split: Literal["test", "validation"]
    device: str
    backend: str
    threads: int | None
    exclusive: bool
    pictures: int
    frame_size: Sequence[int] | None
    outputs: str
    weights_dir: str | None
    report: str | None
    store: Literal["missing", "always", "only"]


def checked_settings(config: DictConfig) -> Settings:
    values = {each.name: config[each.name] for each in fields(Settings) if each.name in config}
    if values.get("frame_size") is not None:
        values["frame_size"] = list(values["frame_size"])
    check_settings(Settings, values)
    settings = Settings(**values)
    if "engine" in config:
        precisions = target_of(config.engine).precisions
        if config.precision not in precisions:
            raise unexpected("precision", " or ".join(precisions), config.precision)
    threads, size = settings.threads, settings.frame_size
    of_size = size is None or (len(size) == 2 and min(size) >= 1)
    for name, right, expected in (
        ("seed", 0 <= settings.seed < 2**63, "0 or more, below 2^63"),
        ("threads", threads is None or threads >= 1, "1 or more, or null"),
        ("pictures", settings.pictures >= 0, "0 or more"),
        ("frame_size", of_size, "[WIDTH, HEIGHT], each 1 or more, or null"),
        ("device", DEVICE.fullmatch(settings.device), "auto, cpu, cuda or cuda:N"),
    ):
        if not right:
            raise unexpected(name, expected, values[name])
    _, _, number = settings.device.partition(":")
    if settings.device.startswith("cuda") and int(number or 0) >= torch.cuda.device_count():
        raise Unavailable(
            f"device={settings.device}: torch sees {torch.cuda.device_count() or 'no'} GPUs here, "
            "numbered from 0; use another, or device=cpu"
        )
    return settings


def use_threads(settings: Settings) -> None:
    """Let torch, and the kernels with it, use as many threads as the settings say from now on."""
    threads, cores = settings.threads or USUAL_THREADS, len(os.sched_getaffinity(0))
    if settings.threads and threads > cores:
        print(f"threads={threads}: more than the {cores} cores here are slower", file=sys.stderr)
    torch.set_num_threads(threads)


def training_threads(config: DictConfig) -> int:
    """How many cores a training keeps busy."""
    cores = len(os.sched_getaffinity(0))
    threads = build(config, "budget").threads or config.threads
    return min(threads, cores) if isinstance(threads, int) else cores


def trained(
    config: DictConfig, log: ConsoleLog, scene: Scene | None = None, progress: Log | None = None
) -> Method:
    """The method that `config` describes, trained on its scene, or on `scene`, when it has a turn
    on its device; the training tells `progress` of itself, by default the `log`."""
    settings = checked_settings(config)
    use_threads(settings)
    torch.manual_seed(settings.seed)
    method = build(config, "method")
    budget = build(config, "budget")
    scene = scene or scene_of(config)
    turn = device_lock(settings.device, log, training_threads(config))
    try:
        with turn if settings.exclusive else nullcontext(), as_begun():
            fit(method, scene, budget, settings.seed, progress or log)
    except Exception:
        forget_scene()  # the method may have spoilt it
        raise
    return method


def protocol_of(config: DictConfig) -> EvaluationProtocol:
    """The protocol that `config` describes; raises if it is called like one of ours, but differs
    from it."""
    node = config.protocol
    file = CONFIGS / "protocol" / f"{node.get('name')}.yaml"
    if file.is_file():
        ours = OmegaConf.load(file)
        known = {**OmegaConf.load(CONFIGS / "protocol" / f"{STANDARD}.yaml"), **ours}
        free = () if node.name == STANDARD else OF_TIMING
        changed = [
            str(name)
            for name, of in known.items()
            if name not in ("defaults", *free) and node.get(name) != of
        ]
        if changed:
            raise SteerbenchError(
                f"protocol.{changed[0]} differs from what {node.name} says: give the changed "
                "protocol a name of its own (protocol.name=...)"
            )
    return build(config, "protocol")


def scene_of(config: DictConfig) -> Scene:
    """The scene that `config` describes.

    If its trajectory renders held-out training pictures, these, one in eight, are removed from the
    training split, so that a model is never scored on pictures that it was trained on.
    """
    return _current(_scene, config)


def forget_scene() -> None:
    """Read the next scene from its files, whatever a method has made of one that is known."""
    _scene.cache_clear()


def trajectory_of(config: DictConfig, scene: Scene, log: Log) -> Trajectory:
    """The trajectory that `config` describes; says what a user should know of its file."""
    trajectory = build(config, "trajectory", scene)
    for note in trajectory.notes:
        log.info(note)
    return trajectory


def scene_digest(config: DictConfig) -> str:
    return _current(_digest, config)


def scene_folder(config: DictConfig) -> str | None:
    """The folder of the scene; None for an embedded scene."""
    return str(Path(config.scene.path).expanduser().resolve()) if "path" in config.scene else None


class _Read(NamedTuple):
    """What was made of files, and how these were then."""

    value: Any  # a Scene, or its digest
    files: Sequence[Path]
    stamps: Mapping[str, Stamp]


@cache
def _digest(node: str, root: Path, held_out: bool) -> _Read:
    """Cached, because it takes loading the whole scene."""
    read = _scene(node, root, held_out)
    return read._replace(value=read.value.digest)


@lru_cache(maxsize=1)
def _scene(node: str, root: Path, held_out: bool) -> _Read:
    """Cached for the next job of a sweep."""
    config = OmegaConf.create({"scene": OmegaConf.create(node)})
    scene = build(config, "scene", log=ConsoleLog(root))
    if held_out:
        scene = hold_out(scene, VALIDATION, 8)
    return _Read(scene, scene.files, _stamps(scene.files))


def _current(read: Any, config: DictConfig) -> Any:
    """What the cached function `read` has of a scene; read again if a file has changed since."""
    node, outputs = OmegaConf.to_yaml(config.scene, resolve=True), Path(config.outputs)
    held_out = OmegaConf.select(config, "trajectory.split") == VALIDATION
    found = read(node, outputs, held_out)
    if not found.files or found.stamps != _stamps(found.files):  # of which, nobody knows
        read.cache_clear()
        _scene.cache_clear()
        found = read(node, outputs, held_out)
    return found.value


def _stamps(files: Iterable[Path]) -> dict[str, Stamp]:
    """The `stamp` of each file, and of all files beside it: pictures may be added, lists of names
    changed."""
    folders = {file.parent for file in files}
    return {
        str(path): stamp(path) if path.is_file() else ()
        for folder in filter(Path.is_dir, folders)
        for path in folder.iterdir()
    }


def build(config: DictConfig, group: str, *args: Any, **extra: Any) -> Any:
    """Call the `_target_` of `config[group]` with its settings, `args` and `extra`.

    Nodes below it that have a `_target_` are built first. SteerbenchError if a setting is missing,
    unknown to its target or of the wrong type. Exceptions of a target pass through.
    """
    try:
        missing = sorted(OmegaConf.missing_keys(config[group]))  # full keys: "scene.path"
        if missing:
            raise SteerbenchError(f"{missing[0]} is not set: give {missing[0]}=...")
        node: Any = OmegaConf.to_container(config[group], resolve=True)
    except OmegaConfBaseException as error:  # a setting that others use was removed (~backend)
        raise SteerbenchError(f"{group}: {str(error).splitlines()[0]}") from error
    target = target_of(node)
    given = [*list(inspect.signature(target).parameters)[: len(args)], *extra]
    check_settings(target, node, f"{group}.", given)
    try:
        prepared = instantiate(as_declared(node), _partial_=True, _convert_="all")
        return prepared(*args, **extra)
    except (InstantiationException, ValueError) as error:
        cause = (isinstance(error, InstantiationException) and error.__cause__) or error
        if isinstance(cause, ValueError):  # the target's message names the setting
            raise SteerbenchError(f"{group}: {cause}") from error
        raise cause from error


def as_declared(node: Any) -> Any:
    """The settings of a node in the types that its `_target_` and those below it declare: `2` and
    `2.0` are the same length, in one key and one training."""
    if not isinstance(node, dict):
        return node
    hints = _hints(target_of(node)) if "_target_" in node else {}
    return {name: coerced(as_declared(value), hints.get(name, Any)) for name, value in node.items()}


def _hints(target: Any) -> dict[str, Any]:
    # Types of inherited dataclass fields must be looked up in the modules of its bases.
    plain = inspect.isclass(target) and not is_dataclass(target)
    return get_type_hints(target.__init__ if plain else target)


def check_settings(
    target: Any, settings: Mapping[str, Any], prefix: str = "", given: Collection[str] = ()
) -> None:
    """Raise `SteerbenchError` unless `target` accepts these settings, by name and type.

    Errors put `prefix` before the names. Parameters `given` by the caller are not settings.
    Settings that are nodes with a `_target_` are checked against that target.
    """
    hints = _hints(target)
    parameters = inspect.signature(target).parameters
    names = [name for name in parameters if name not in given]
    if not settings.get("_partial_"):
        for name in names:  # ~name removes a default of the configurations
            one = parameters[name]
            several = one.kind in (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
            if one.default is inspect.Parameter.empty and not several and name not in settings:
                raise SteerbenchError(f"{prefix}{name} is not set: give {prefix}{name}=...")
    for name, value in settings.items():
        if name.startswith("_"):  # Hydra's own: _target_, _convert_
            continue
        if name not in names:
            raise unknown("setting", f"{prefix}{name}", [f"{prefix}{other}" for other in names])
        if isinstance(value, dict) and "_target_" in value:
            check_settings(target_of(value), value, f"{prefix}{name}.")
        elif not fits(value, hint := hints.get(name, Any)):
            wanted = re.sub(r"\b[a-z_]\w*\.", "", inspect.formatannotation(hint))  # no modules
            if get_origin(hint) is Literal:
                wanted = " or ".join(map(str, get_args(hint)))
            raise unexpected(f"{prefix}{name}", wanted, repr(value))
