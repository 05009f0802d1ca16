"""One timed process at a time on each device: what runs beside other work is not worth timing."""

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
    """Wait until no other process of this machine measures on `device`, as `steerbench run` names
    it, and keep others waiting. The system releases the lock of a process that is killed."""
    waiting = f"waiting: another process measures on {device}"
    return locked(lock_file(device), waiting, log)


def on_gpu(device: str) -> bool:
    """Whether `device`, as `steerbench run` names it, is a GPU."""
    return device.startswith("cuda") or (device == "auto" and torch.cuda.is_available())


def lock_file(device: str) -> Path:
    """The file to lock. It is not in `outputs`, which may lie on a file system without locks.

    GPUs are told apart by their UUID: each job may see its own as the first.
    """
    if device == "auto":
        device = "cuda" if on_gpu(device) else "cpu"
    which = torch.cuda.get_device_properties(device).uuid if on_gpu(device) else device
    name = hashlib.sha256(f"{platform.node()} {which}".encode()).hexdigest()[:16]
    return _folder() / f"steerbench-{name}.lock"


def _folder() -> Path:
    """One for all users and jobs: Slurm gives each job a /tmp and a /dev/shm of its own."""
    if chosen := os.environ.get(FOLDER):
        return Path(chosen)
    shared = Path("/var/tmp")
    return shared if os.access(shared, os.W_OK) else Path(tempfile.gettempdir())
