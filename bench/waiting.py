"""Who waits for whom: the queue of a device. Timings have it alone, trainings share its cores."""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bench.sharing import locked

if TYPE_CHECKING:  # loads rich
    from bench.console import ConsoleLog

LOOK_S = 0.2  # how often who waits looks whether it is its turn
REST_S = 1.0  # a timing begins so long after those it waited for: they print, or end, meanwhile
WRITE_S = 2.0  # how often at most a process writes how far it is


@dataclass
class Holder:
    """What the file of a process in a queue says; `threads` None: it needs the device alone."""

    threads: int | None
    cores: Sequence[int]
    pid: int = 0
    command: str = ""
    since: float = 0.0
    progress: str = ""

    def blocking(self, earlier: Sequence[Holder]) -> Sequence[Holder]:
        """Those that came `earlier` and that it waits for.

        A training waits for timings, and for trainings with which the cores were too few. Whoever
        still waits counts as if it were its turn: nobody overtakes.
        """
        if self.threads is None or any(other.threads is None for other in earlier):
            return earlier
        beside = [other for other in earlier if set(self.cores).intersection(other.cores)]
        wanted = self.threads + sum(other.threads or 0 for other in beside)
        return beside if wanted > len(self.cores) else ()


@contextmanager
def queued(path: Path, threads: int | None, what: str, log: ConsoleLog) -> Iterator[None]:
    """Wait in the queue of the device `what` for a turn with so many `threads`, or alone; hold it.

    Each process in the queue has a numbered file beside `path`, locked while it lives: the system
    releases the lock of one that is killed. Where the file system has no locks, nobody waits.
    """
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    own = Holder(threads, sorted(os.sched_getaffinity(0)), os.getpid(), command, time.time())

    def write() -> None:
        file.write_text(json.dumps(vars(own)))

    with ExitStack() as place:
        with locked(path, f"waiting: others come to {what}", log):
            for file in _files(path):
                if _read(file) is None:
                    with suppress(PermissionError):  # it is of another user
                        file.unlink()
            last = max((int(file.stem.rpartition("-")[2]) for file in _files(path)), default=0)
            file = path.with_name(f"{path.stem}-{last + 1:09}.json")
            place.callback(file.unlink, missing_ok=True)
            place.enter_context(locked(file, "", log))
            write()
        told = 0
        while blocking := own.blocking([x for f in _files(path) if f < file and (x := _read(f))]):
            if (first := blocking[0]).pid not in (0, told):
                clock = time.strftime("%H:%M:%S", time.localtime(first.since))
                who = f"process {first.pid} ({first.command}) has it since {clock}"
                log.info(f"waiting for {what}: {who}, {first.progress or 'just begun'}")
                told = first.pid
            time.sleep(LOOK_S)
        if told and threads is None:
            time.sleep(REST_S)

        def tell(progress: str) -> None:
            with suppress(OSError):
                if time.time() > file.stat().st_mtime + WRITE_S:
                    own.progress = progress
                    write()

        own.since = time.time()
        write()
        log.followers.append(tell)
        place.callback(log.followers.remove, tell)
        yield


def _files(path: Path) -> list[Path]:
    return sorted(path.parent.glob(f"{path.stem}-*.json"))


def _read(file: Path) -> Holder | None:
    """What a file of the queue says; None if its process has left or was killed."""
    try:
        with file.open("rb") as handle:
            fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        with suppress(OSError, ValueError, TypeError):
            return Holder(**json.loads(file.read_bytes()))
        return Holder(None, ())  # it is just writing that
    except OSError:  # it has left, or there are no locks
        return None
    return None
