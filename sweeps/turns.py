"""Jobs of a sweep take turns on a device: what runs beside another job is not worth timing."""

from __future__ import annotations

import fcntl
import hashlib
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from bench.types import Log


@contextmanager
def turn(outputs: Path, device: str, log: Log) -> Iterator[None]:
    """Have `device`, as of `steerbench run`, alone among this machine's processes that write to
    `outputs`.

    The system ends the turn of a process that is killed.
    """
    with lock_file(outputs, device).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.info(f"waiting: another process measures on {device}")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def lock_file(outputs: Path, device: str) -> Path:
    """What is locked: not in `outputs`, which may lie on a file system that has no locks.

    Graphics processors are told apart by what they are: each job may see its own as the first.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    on_gpu = device.startswith("cuda")
    which = torch.cuda.get_device_properties(device).uuid if on_gpu else device
    name = hashlib.sha256(f"{outputs.resolve()} {which}".encode()).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f"steerbench-{name}.lock"
