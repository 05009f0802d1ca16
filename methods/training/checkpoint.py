"""Files of trained and half-trained stages: tensors and numbers, written whole or not at all."""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from bench.errors import reason
from bench.sharing import whole
from bench.types import SteerbenchError
from methods.kernels.adam import AdamState

Tensors = dict[str, Tensor]  # by name


def write(path: Path, tensors: Tensors, figures: Mapping[str, float]) -> None:
    """Write a file whole or not at all, even if another process writes the same file; raise
    `SteerbenchError` if it cannot be written."""
    packed = {name: tensor.contiguous() for name, tensor in tensors.items()}
    try:
        with whole(path) as new:
            held = json.dumps(figures)
            save_file(packed, new, {"training": held, "sha256": _sum(packed, held)})
            with new.open("rb") as file:
                os.fsync(file.fileno())
    except (OSError, SafetensorError) as error:
        raise SteerbenchError(f"{path}: cannot write the checkpoint: {error}") from error


def read(path: Path) -> tuple[Tensors, dict[str, float]]:
    """Read the tensors and figures of a file; raise `SteerbenchError` if it is damaged, or was not
    written by `write`."""
    try:
        with safe_open(path, "pt") as file:
            held, promised = (file.metadata()[name] for name in ("training", "sha256"))
        tensors = load_file(path)
        if _sum(tensors, held) != promised:
            raise ValueError("its checksum is wrong")
        return tensors, json.loads(held)
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise SteerbenchError(
            f"{path}: expected the file of a training, could not read one ({error}); "
            "remove it, and it is made again"
        ) from error


def _sum(tensors: Tensors, figures: str) -> str:
    """SHA-256 of the names and the content of `tensors`, and of `figures`."""
    total = hashlib.sha256(figures.encode())
    for name, tensor in sorted(tensors.items()):
        total.update(f"{name} {tensor.dtype} {[*tensor.shape]}".encode())
        total.update(tensor.reshape(-1).view(torch.uint8).cpu().numpy().data)
    return total.hexdigest()


@contextmanager
def restoring(path: Path) -> Iterator[None]:
    """Context in which state that was read from `path` is restored; it raises `SteerbenchError` if
    the state belongs to another training, and so does not fit."""
    try:
        yield
    except (KeyError, RuntimeError) as error:
        raise SteerbenchError(
            f"{path}: expected the file of this training, its content does not fit "
            f"({reason(error)}); remove it to train again"
        ) from error


def part(tensors: Tensors, prefix: str) -> Tensors:
    """The tensors whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}


Optimisers = Mapping[str, torch.optim.Optimizer | AdamState]  # those of a training, by name


def of_optimisers(optimisers: Optimisers) -> Tensors:
    """The state of `optimisers`, whose names begin its names."""
    found: Tensors = {}
    for name, one in optimisers.items():
        if isinstance(one, AdamState):
            found |= {f"{name}.{slot}": x for slot, x in one.tensors().items()}
        else:
            slots = one.state_dict()["state"].items()
            found |= {f"{name}.{n}.{slot}": x for n, of in slots for slot, x in of.items()}
    return found


def restore_optimisers(optimisers: Optimisers, tensors: Tensors) -> None:
    """Restore what `of_optimisers` returned."""
    for name, one in optimisers.items():
        own = part(tensors, f"{name}.")
        if isinstance(one, AdamState):
            one.restore(own)
        else:
            _restore(one, own)


def _restore(optimiser: torch.optim.Optimizer, tensors: Tensors) -> None:
    state = optimiser.state_dict()
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    for name, value in tensors.items():
        number, slot = name.split(".")
        parameter = parameters[int(number)]
        if value.shape == parameter.shape:
            # In the parameter's memory order, which files do not keep but a fused step expects.
            value = torch.empty_like(parameter).copy_(value)
        state["state"].setdefault(int(number), {})[slot] = value
    optimiser.load_state_dict(state)
