"""Jobs of a sweep take turns on a device: what runs beside another job is not worth timing."""

from __future__ import annotations

import fcntl
import os
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench.results import explained
from bench.types import Log


@contextmanager
def turn(outputs: Path, device: str, log: Log) -> Iterator[None]:
    """Have `device` of this machine alone among all processes that write to `outputs`.

    The system ends the turn of a process that is killed.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "") if device.startswith("cuda") else ""
    name = re.sub(r"[^\w.-]", "-", f"{platform.node()}-{device}{visible and f'-of-{visible}'}")
    path = outputs / "locks" / f"{name}.lock"
    with explained(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("w")
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.info(f"waiting: another process measures on {device}")
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
