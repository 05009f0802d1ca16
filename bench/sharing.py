"""Files shared by processes, users and machines: written atomically, made only once, and checked
when they are read.

A lock is released when its process ends, no matter how it ends.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from bench.errors import SteerbenchError, explained, unexpected

if TYPE_CHECKING:  # loads torch; a lock should not wait for that
    from bench.types import Log

SUMS = "SHA256SUMS"  # in a folder: the checksums of its files, as `sha256sum --check` reads them


def file_sha256(path: Path) -> str | None:
    """SHA-256 of a file's content; None if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return None


def write_sums(folder: Path, pattern: str = "*", sums: str = SUMS) -> None:
    """Keep the checksums of all files below `folder` whose names fit `pattern` in its file `sums`,
    for `check_sums`."""
    files = sorted(path for path in folder.rglob(pattern) if path.is_file() and path.name != sums)
    lines = [f"{file_sha256(file)}  {file.relative_to(folder).as_posix()}\n" for file in files]
    (folder / sums).write_text("".join(lines), encoding="utf-8")


def check_sums(folder: Path, names: Iterable[str] | None = None, sums: str = SUMS) -> None:
    """Raise SteerbenchError unless the files `names` in `folder`, or all, are as they were when
    `write_sums` was called."""
    try:
        lines = (folder / sums).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise unexpected(folder / sums, "checksums of the files beside it", error) from error
    known = {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
    for name in known if names is None else names:
        if file_sha256(folder / name) != known.get(name, "none"):
            raise SteerbenchError(
                f"{folder / name}: damaged, or changed since it was written ({sums}); "
                f"remove {folder}, and it is made again"
            )


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A temporary file beside `path`, with its ending; it becomes `path` unless the body raises."""
    new = path.with_name(f".{path.stem}-{uuid.uuid4().hex}{path.suffix}")
    try:
        yield new
        new.replace(path)
    finally:
        new.unlink(missing_ok=True)


@contextmanager
def locked(path: Path, waiting: str, log: Log) -> Iterator[None]:
    """Hold an exclusive lock on the file `path`, which is created if missing and never removed.

    `waiting` is logged while another process holds it. If the file system has no locks, that is
    logged and the body runs anyway; at worst, work is then done twice. Raises SteerbenchError if
    `path` cannot be opened for writing.
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
    """Whether `path` must still be made: if so, the body does, while others wait; see `locked`."""
    if path.exists():
        yield False
        return
    waiting = f"waits for another process that makes the same: {path}"
    with locked(path.with_name("lock"), waiting, log):
        yield not path.exists()


def _lock(handle: int, waiting: str, log: Log) -> None:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        log.info(waiting)
        fcntl.flock(handle, fcntl.LOCK_EX)


def _opened(path: Path) -> int:
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL)
    except FileExistsError:
        # No O_CREAT: in a world-writable folder it is refused for a file of another user.
        return os.open(path, os.O_RDWR)
    with suppress(OSError):  # some file systems have no modes
        os.fchmod(handle, 0o666)  # regardless of umask, so that other users can lock it, too
    return handle
