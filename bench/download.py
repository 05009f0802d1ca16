"""Downloads a file: checked, and continued where an earlier attempt broke off."""

from __future__ import annotations

import logging
from pathlib import Path

from bench.errors import Unavailable
from bench.types import Log

TIMEOUT_S = 10.0
CHUNK_BYTES = 1 << 16
PARTIAL = 206
"""The HTTP status of an answer that begins where it was asked to."""


def fetch(address: str, target: Path, sha256: str | None, log: Log) -> Path:
    """`target`, downloaded from `address` unless it is there and right.

    What an interrupted download got waits beside it for the next attempt: no other process may
    fetch the same meanwhile.

    Args:
        sha256: of the content; None: whatever comes is right.

    Raises:
        Unavailable: there is no answer, it breaks off, or the content is another.
        OSError: `target` cannot be written.
    """
    import pooch  # here, because it takes a tenth of a second that few commands need to spend
    from requests import RequestException

    pooch.get_logger().setLevel(logging.WARNING)
    continued = _Continued(target, log)
    try:
        pooch.retrieve(address, sha256, target.name, target.parent, downloader=continued)
    except RequestException as error:
        raise Unavailable(f"the download of {address} failed ({error})") from error
    except ValueError as error:  # of pooch, which has deleted the file
        raise Unavailable(f"the download of {address} is damaged: {error}") from error
    return target


class _Continued:
    """A downloader for pooch."""

    def __init__(self, target: Path, log: Log) -> None:
        self._name, self._log = target.name, log
        self._part = target.with_name(f".{target.name}.part")

    def __call__(self, address: str, output_file: str, pooch: object) -> None:
        import requests

        there = self._part.stat().st_size if self._part.exists() else 0
        asked = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={there}-"} if there else {})
        with requests.get(address, headers=asked, stream=True, timeout=TIMEOUT_S) as answer:
            if answer.status_code == requests.codes.requested_range_not_satisfiable:
                self._part.unlink()  # it is longer than what lies there now
                return self(address, output_file, pooch)
            answer.raise_for_status()
            if answer.status_code != PARTIAL:
                there = 0
            total = there + int(answer.headers.get("Content-Length", 0))
            with (
                self._part.open("ab" if there else "wb") as file,
                self._log.progress(f"downloading {self._name}", total) as progress,
            ):
                progress.advance(there)
                for chunk in answer.iter_content(CHUNK_BYTES):
                    file.write(chunk)
                    progress.advance(len(chunk))
        self._part.replace(output_file)
