"""The loop of every training: progress, checkpoints, resuming after a kill, finiteness checks,
learning rates."""

import math
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import ClassVar, Protocol

import torch
from torch import Tensor

from bench.memory import MemoryMeter
from bench.provenance import digest
from bench.sharing import missing
from bench.types import Log, SteerbenchError, TwoTensors
from methods.training import checkpoint
from methods.training.checkpoint import Optimisers, Tensors

LOOK_EVERY = 10
"""On a GPU, errors are read back only every so many steps, because reading takes time."""

CHECKPOINT_S = 20.0  # seconds between checkpoints: the most that a killed training loses

Asked = Callable[[], dict[str, float]]
"""Tells the errors of a step, by label; the host waits if they have not arrived yet."""


class Training(Protocol):
    """What the loop drives."""

    advice: ClassVar[str]  # what to try if the training breaks down
    steps: int  # how many there are in all
    step: int = 0  # how many are done
    seconds: float = 0.0  # the time they took, over all the processes the training was continued in
    asked: Asked | None = None  # the errors that `look` requested last
    peak_bytes: float = 0.0  # of the memory that it took, over these processes, in its last file
    meter: MemoryMeter | None = None  # that measures it
    generator: torch.Generator

    def advance(self) -> Mapping[str, float]:
        """Take one step; return what `look` returns, the mean squared errors to show by label (""
        for the main one)."""

    def optimisers(self) -> Optimisers:
        """The optimisers, which a checkpoint keeps."""

    def watched(self) -> Tensors:
        """The tensors that must be finite in a good state, by name."""

    def result(self) -> Tensors:
        """The tensors that the training is for."""

    def restore_result(self, tensors: Tensors) -> None:
        """Restore what `result` returned."""

    def state(self) -> Tensors:
        """What a checkpoint must hold, besides the result, to go on as if never stopped."""
        tensors = checkpoint.of_optimisers(self.optimisers())
        return tensors | {"generator": self.generator.get_state()}

    def restore(self, tensors: Tensors) -> None:
        """Restore result and state."""
        self.restore_result(tensors)
        checkpoint.restore_optimisers(self.optimisers(), tensors)
        self.generator.set_state(tensors["generator"].cpu())


def trained(
    begin: Callable[[], Training], finished: Path, label: str, device: torch.device, log: Log
) -> tuple[Tensors, float, float]:
    """The result of the training on `device` that `begin` makes, seconds and peak memory, of making
    it and of all its steps: read from `finished`, after a `train` if that is missing."""
    if finished.exists():
        log.info(f"trained {label} found: {finished}")
    else:
        begun = time.monotonic()
        meter = MemoryMeter(str(device))
        with meter:
            training = begin()
            training.seconds = time.monotonic() - begun
            training.meter = meter
            train(training, finished, label, log)
    tensors, figures = checkpoint.read(finished)
    with checkpoint.restoring(finished):
        return tensors, figures["seconds"], figures["peak_bytes"]


def train(training: Training, finished: Path, label: str, log: Log) -> None:
    """Drive `training` to its end and write its result to `finished`, or load the result there.

    If another process runs the same training, this one waits for it. A killed training resumes from
    the checkpoint beside `finished`. `SteerbenchError` is raised if something is not finite; the
    last good checkpoint is kept.
    """
    with missing(finished, log) as to_train:
        if to_train:
            _drive(training, finished, label, log)
        else:
            load(training, finished, done=True)
            log.info(f"{label}: found in {finished}")


def _drive(training: Training, finished: Path, label: str, log: Log) -> None:
    unfinished = finished.with_name("checkpoint.safetensors")
    if unfinished.exists():
        load(training, unfinished)
        log.info(f"going on from step {training.step} of {unfinished}")
    saved = time.monotonic()
    began = saved - training.seconds
    means: dict[str, float] = {}
    with log.progress(label, training.steps) as progress:
        progress.advance(training.step)
        while training.step < training.steps:
            for name, mse in training.advance().items():
                means[name] = 0.99 * means.get(name, mse) + 0.01 * mse
            progress.advance(note=", ".join(map(_decibels, means.items())))
            training.seconds = time.monotonic() - began
            if time.monotonic() - saved > CHECKPOINT_S:
                save(training, unfinished)
                saved = time.monotonic()
    digest(type(training))  # refuses if its code was changed: the key is that of the old one
    save(training, finished, done=True)
    unfinished.unlink(missing_ok=True)


def _decibels(error: tuple[str, float]) -> str:
    name, mse = error
    return f"{name} {-10 * math.log10(max(mse, 1e-10)):.1f} dB".strip()


def save(training: Training, path: Path, done: bool = False) -> None:
    """Write the result and, unless `done`, the state. Something that is not finite raises
    `SteerbenchError` and leaves the last good file alone."""
    check_finite(training)
    if training.meter:
        training.peak_bytes = max(training.peak_bytes, training.meter.look())
    figures = {name: getattr(training, name) for name in ("step", "seconds", "peak_bytes")}
    checkpoint.write(path, training.result() | ({} if done else training.state()), figures)


def load(training: Training, path: Path, done: bool = False) -> None:
    """Restore what `save` wrote to `path`: the result and, unless `done`, the state; raise
    `SteerbenchError` if the file is damaged, or belongs to another training."""
    tensors, figures = checkpoint.read(path)
    with checkpoint.restoring(path):
        if done:
            training.restore_result(tensors)
        else:
            training.restore(tensors)
        training.step, training.seconds = int(figures["step"]), figures["seconds"]
        training.peak_bytes = figures["peak_bytes"]


def look(training: Training, errors: Callable[[], Tensors], tensors: Tensors) -> dict[str, float]:
    """Return the `errors` of a step as numbers; raise `SteerbenchError` if one is not finite, with
    the names of the `tensors` that are not. On a GPU this happens every `LOOK_EVERY` steps, with
    the errors that were requested the time before, which have arrived meanwhile; in all other steps
    there are none."""
    on_cpu = all(tensor.device.type == "cpu" for tensor in tensors.values())
    if not on_cpu and training.step % LOOK_EVERY:
        return {}
    with torch.no_grad():
        before = training.asked
        training.asked = _ask(errors())
    asked = training.asked if on_cpu else before
    told = {} if asked is None else asked()
    if not all(map(math.isfinite, told.values())):
        check_finite(training, tensors)
    return told


def _ask(errors: Tensors) -> Asked:
    """Send the errors to the host, which does not wait for them."""
    together = torch.stack([error.detach() for error in errors.values()])
    labels = list(errors)
    values = together.to("cpu", non_blocking=True)
    arrived = None
    if together.device.type == "cuda":
        arrived = torch.cuda.current_stream(together.device).record_event()

    def tell() -> dict[str, float]:
        if arrived is not None:
            arrived.synchronize()
        return dict(zip(labels, values.tolist(), strict=True))

    return tell


def check_finite(training: Training, more: Tensors | None = None) -> None:
    """Raise `SteerbenchError` naming the step and the tensors that are not finite, if any are."""
    tensors = {**training.watched(), **(more or {})}
    bad = [name for name, tensor in tensors.items() if not tensor.isfinite().all()]
    if bad:
        raise SteerbenchError(
            f"training stopped at step {training.step}: not finite: {', '.join(bad)}. The last "
            f"good checkpoint was kept. {training.advice}"
        )


def as_known(picture: Tensor, truth: Tensor) -> TwoTensors:
    """Both, alike and without a gradient where the truth is NaN: there, pixels do not count."""
    unknown, shown = truth.isnan(), picture.detach()
    return shown.where(unknown, picture), shown.where(unknown, truth)


def cosine(done: float, final: float, half_waves: int = 1) -> float:
    """Share of the learning rate left after a share `done` of the steps: from 1 to `final`. One
    half wave falls all the way; three fall, rise to 1 again, and fall."""
    return final + (1 - final) * 0.5 * (1 + math.cos(half_waves * math.pi * done))


def step_at(optimiser: torch.optim.Optimizer, rate: float) -> None:
    """Take a step at learning rate `rate` and clear the gradients."""
    for group in optimiser.param_groups:
        group["lr"] = rate
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)
