"""Files that several processes share, also of other users and machines: whole, and made once.

A lock ends with the process that holds it, however that ends.
"""

from __future__ import annotations

import fcntl
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.errors import explained

if TYPE_CHECKING:  # it loads torch, for which no lock should wait
    from bench.types import Log


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A file beside `path` to write, which becomes `path` when the body ends without an exception.

    Its name is unique, and ends as `path` does.
    """
    new = path.with_name(f".{path.stem}-{uuid.uuid4().hex}{path.suffix}")
    try:
        yield new
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


@contextmanager
def locked(path: Path, waiting: str, log: Log) -> Iterator[None]:
    """Hold the lock file `path`, made if missing and never removed, alone among all processes.

    `waiting` is logged while another process holds it. Where the file system has no locks, that is
    logged, and the work is done all the same, at worst twice.

    Raises:
        SteerbenchError: `path` cannot be opened for writing.
    """
    with explained(path.parent):
        handle = _opened(path)
    try:
        try:
            _lock(handle, waiting, log)
        except OSError as error:
            log.info(f"not locked, others may do the same meanwhile: {path}: {error.strerror}")
        yield
    finally:
        os.close(handle)


@contextmanager
def missing(path: Path, log: Log) -> Iterator[bool]:
    """Whether `path` is still to be made: the body makes it, and no other process meanwhile.

    Raises:
        SteerbenchError: the folder of `path` cannot be written to.
    """
    if path.exists():
        yield False
        return
    waiting = f"waits for another process that makes the same: {path}"
    with locked(path.with_name("lock"), waiting, log):
        yield not path.exists()


def _opened(path: Path) -> int:
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
    except FileExistsError:
        # Without O_CREAT: in a folder for everybody, that is refused for the file of another user.
        return os.open(path, os.O_RDWR)
    with suppress(OSError):  # some file systems have no modes
        os.fchmod(handle, 0o666)  # whatever the umask: other users take turns, too
    return handle


def _lock(handle: int, waiting: str, log: Log) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        log.info(waiting)
        fcntl.flock(handle, fcntl.LOCK_EX)
