"""Whatever is timed takes turns on a device: what runs beside other work is not worth timing."""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from contextlib import AbstractContextManager
from pathlib import Path

import torch

from bench.sharing import locked
from bench.types import Log

FOLDER = "STEERBENCH_LOCKS"
"""Of the environment: another folder for the locks."""


def turn(device: str, log: Log) -> AbstractContextManager[None]:
    """Have `device`, as of `steerbench run`, alone among all that is timed on this machine.

    The system ends the turn of a process that is killed.
    """
    waiting = f"waiting: another process measures on {device}"
    return locked(lock_file(device), waiting, log)


def lock_file(device: str) -> Path:
    """What is locked: not in `outputs`, which may lie on a file system that has no locks.

    Graphics processors are told apart by what they are: each job may see its own as the first.
    """
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    on_gpu = device.startswith("cuda")
    which = torch.cuda.get_device_properties(device).uuid if on_gpu else device
    name = hashlib.sha256(f"{platform.node()} {which}".encode()).hexdigest()[:16]
    return _folder() / f"steerbench-{name}.lock"


def _folder() -> Path:
    """One for all users and jobs: Slurm gives each job a /tmp and a /dev/shm of its own."""
    if chosen := os.environ.get(FOLDER):
        return Path(chosen)
    everybodys = Path("/var/tmp")
    return everybodys if os.access(everybodys, os.W_OK) else Path(tempfile.gettempdir())
