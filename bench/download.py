"""Downloads a file, and checks it."""

from pathlib import Path

from bench.sharing import file_sha256, whole
from bench.types import Log, Unavailable

CONNECT_S, READ_S = 3.0, 10.0  # so long it waits for a connection, and for an answer


def fetch(address: str, target: Path, sha256: str | None, log: Log) -> Path:
    """Download `address` to `target` unless it is there already and correct; returns `target`.

    A download that breaks off leaves nothing. `sha256` None: the content is not checked. Raises
    Unavailable without an answer, if the connection breaks off, or the content has another hash.
    """
    if target.exists() and sha256 in (None, file_sha256(target)):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    with whole(target) as new:
        _download(address, new, target.name, log)
        if sha256 not in (None, got := file_sha256(new)):
            said = f"expected a file with SHA-256 {sha256}, got {got}"
            raise Unavailable(f"the download of {address} is damaged: {said}")
    return target


def _download(address: str, file: Path, name: str, log: Log) -> None:
    import requests  # imported here: it takes 0.1 s, and few commands need it

    try:
        with requests.get(address, stream=True, timeout=(CONNECT_S, READ_S)) as answer:
            answer.raise_for_status()
            total = int(answer.headers.get("Content-Length", 0))
            bar = log.progress(f"downloading {name}", total)
            with file.open("wb") as content, bar as progress:
                for chunk in answer.iter_content(1 << 16):
                    content.write(chunk)
                    progress.advance(len(chunk))
    except requests.RequestException as error:
        # The message of a lost connection is that of four nested exceptions.
        offline = type(error) in (requests.ConnectionError, requests.ConnectTimeout)
        why = "no connection" if offline else error
        raise Unavailable(f"the download of {address} failed ({why})") from error
