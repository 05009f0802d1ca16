"""Records in `outputs` why a job failed, until it succeeds; reports show that in its place."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from bench.errors import explained
from bench.results import content_key
from bench.sharing import whole


def reason(error: BaseException) -> str:
    """The message of `error` in one line."""
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def printed() -> Iterator[None]:
    """Print an error of the body and go on, so that it does not hide the failure being recorded."""
    try:
        yield
    except Exception as error:
        print(f"steerbench: {reason(error)}", file=sys.stderr)


def keep(outputs: Path, job: Mapping[str, Any], why: str) -> None:
    """Record why the `job` with these settings failed."""
    path = _path(outputs, job)
    with explained(path.parent):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as new:
            new.write_text(f"{why}\n", encoding="utf-8")


def forget(outputs: Path, job: Mapping[str, Any]) -> None:
    """Remove the record of `job`, which has succeeded."""
    _path(outputs, job).unlink(missing_ok=True)


def last(outputs: Path, job: Mapping[str, Any]) -> str | None:
    """Why `job` failed in its last attempt; None if it did not."""
    path = _path(outputs, job)
    return path.read_text(encoding="utf-8").strip() if path.exists() else None


def _path(outputs: Path, job: Mapping[str, Any]) -> Path:
    return outputs / "failures" / f"{content_key(job)[:16]}.txt"
