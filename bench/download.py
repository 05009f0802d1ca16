"""Downloads a file, checks it, and resumes an earlier attempt that broke off."""

from __future__ import annotations

import logging
from pathlib import Path

from bench.errors import Unavailable
from bench.types import Log

TIMEOUT_S = 10.0
CHUNK_BYTES = 1 << 16
PARTIAL = 206
"""HTTP status 206: the answer begins at the requested byte."""


def fetch(address: str, target: Path, sha256: str | None, log: Log) -> Path:
    """Download `address` to `target` unless it is there already and correct; returns `target`.

    An interrupted download leaves its part beside `target`, and the next attempt resumes it. Two
    processes must not fetch the same file at once.

    Args:
        sha256: expected hash of the content; None: not checked.

    Raises:
        Unavailable: no answer, the connection breaks off, or the content has another hash.
        OSError: `target` cannot be written.
    """
    import pooch  # imported here: it takes 0.1 s, and few commands need it
    from requests import RequestException

    pooch.get_logger().setLevel(logging.WARNING)
    continued = _Continued(target, log)
    try:
        pooch.retrieve(address, sha256, target.name, target.parent, downloader=continued)
    except RequestException as error:
        raise Unavailable(f"the download of {address} failed ({_reason(error)})") from error
    except ValueError as error:  # from pooch, which has deleted the file
        raise Unavailable(f"the download of {address} is damaged: {error}") from error
    return target


def _reason(error: Exception) -> str:
    """Why a download failed, in a few words: requests nests the cause in four exceptions."""
    from requests.exceptions import ConnectionError, ProxyError, SSLError

    lost = isinstance(error, ConnectionError) and not isinstance(error, (ProxyError, SSLError))
    return "no connection" if lost else str(error)


class _Continued:
    """A downloader for pooch that resumes a partial file."""

    def __init__(self, target: Path, log: Log) -> None:
        self._name, self._log = target.name, log
        self._part = target.with_name(f".{target.name}.part")

    def __call__(self, address: str, output_file: str, pooch: object) -> None:
        import requests

        there = self._part.stat().st_size if self._part.exists() else 0
        asked = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={there}-"} if there else {})
        with requests.get(address, headers=asked, stream=True, timeout=TIMEOUT_S) as answer:
            if answer.status_code == requests.codes.requested_range_not_satisfiable:
                self._part.unlink()  # the part is longer than the file on the server
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
