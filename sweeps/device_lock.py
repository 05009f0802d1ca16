"""Lets only one process at a time measure on a device, because parallel work distorts the times."""

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
"""The environment variable that names another folder for the locks."""


def device_lock(device: str, log: Log) -> AbstractContextManager[None]:
    """Wait until no other process of this machine measures on `device`, then hold the lock.

    `device` is named as in `steerbench run`. If a process is killed, the system releases its lock.
    """
    waiting = f"waiting: another process measures on {device}"
    return locked(lock_file(device), waiting, log)


def on_gpu(device: str) -> bool:
    """Whether `device`, named as in `steerbench run`, is a GPU."""
    return device.startswith("cuda") or (device == "auto" and torch.cuda.is_available())


def lock_file(device: str) -> Path:
    """The file to lock. It is not in `outputs`, which may be on a file system without locks.

    GPUs are identified by UUID, because each job may see its own GPU as the first one.
    """
    if device == "auto":
        device = "cuda" if on_gpu(device) else "cpu"
    which = torch.cuda.get_device_properties(device).uuid if on_gpu(device) else device
    name = hashlib.sha256(f"{platform.node()} {which}".encode()).hexdigest()[:16]
    return _folder() / f"steerbench-{name}.lock"


def _folder() -> Path:
    """The folder shared by all users and jobs; Slurm gives each job its own /tmp and /dev/shm."""
    if chosen := os.environ.get(FOLDER):
        return Path(chosen)
    shared = Path("/var/tmp")
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())
