"""Processes that measure or train: how they are set up, pools of them, and the lock of a device."""

from __future__ import annotations

import hashlib
import multiprocessing
import os
import platform
import tempfile
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from bench.errors import not_there
from bench.memory import keep_freed
from bench.waiting import queued

if TYPE_CHECKING:  # help and completion do not load torch
    from bench.console import ConsoleLog

LOCKS = "STEERBENCH_LOCKS"  # the environment variable that names another folder for the locks


def set_up() -> None:
    """Set what torch reads when it is loaded, and what the memory allocator does.

    Two thread pools take turns here, torch's and numba's. A pool that spins while idle blocks cores
    that the other needs; one that sleeps at once must be woken a thousand times per step. So let it
    spin for some ten microseconds. Large tensors get pages of 2 MB: fewer pages to map, and fewer
    addresses to look up.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "20000")
    os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
    keep_freed()


@contextmanager
def processes(count: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of `count` processes. They end when this one ends, at once if it is interrupted.

    They are spawned, because threads do not survive a fork: for work on which threads would wait
    for Python's lock.
    """
    spawned = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=spawned, initializer=_begin)
    try:
        yield pool
    except (KeyboardInterrupt, SystemExit):
        for process in multiprocessing.active_children():
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _begin() -> None:
    set_up()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def device_lock(device: str, log: ConsoleLog, threads: int | None = None) -> Iterator[None]:
    """Wait for a turn on `device`, named as in `steerbench run`, and hold it.

    Without `threads` alone: parallel work would distort the times. A training of so many threads
    has a turn beside others, as far as there are cores, but a GPU alone.
    """
    what = f"{device} (exclusive=false waits for nobody; ${LOCKS} may name another folder)"
    with queued(lock_file(device), None if on_gpu(device) else threads, what, log):
        yield


def on_gpu(device: str) -> bool:
    """Whether `device`, named as in `steerbench run`, is a GPU."""
    import torch

    return device.startswith("cuda") or (device == "auto" and torch.cuda.is_available())


def lock_file(device: str) -> Path:
    """The file to lock, in a folder shared by all users and jobs.

    It is not in `outputs`, which may be on a file system without locks; Slurm gives each job its
    own /tmp and /dev/shm. GPUs are identified by UUID, because each job may see its own GPU as the
    first one.
    """
    import torch

    gpu = on_gpu(device)
    if device == "auto":
        device = "cuda" if gpu else "cpu"
    which = torch.cuda.get_device_properties(device).uuid if gpu else device
    name = hashlib.sha256(f"{platform.node()} {which}".encode()).hexdigest()[:16]
    usual = "/var/tmp" if os.access("/var/tmp", os.W_OK) else tempfile.gettempdir()
    folder = Path(os.environ.get(LOCKS) or usual)
    if not folder.is_dir():
        raise not_there(folder, f"a folder for locks, as ${LOCKS} says")
    return folder / f"steerbench-{name}.lock"
