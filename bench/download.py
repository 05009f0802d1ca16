"""Downloads a file, and checks it."""

from __future__ import annotations

from pathlib import Path

from bench.types import Log, Unavailable

TIMEOUT_S = 10.0


def fetch(address: str, target: Path, sha256: str | None, log: Log) -> Path:
    """Download `address` to `target` unless it is there already and correct; returns `target`.

    A download that breaks off leaves nothing. `sha256` None: the content is not checked. Raises
    Unavailable without an answer, if the connection breaks off, or the content has another hash.
    """
    import pooch
    import requests

    def download(address: str, output_file: str, pooch: object) -> None:
        with requests.get(address, stream=True, timeout=TIMEOUT_S) as answer:
            answer.raise_for_status()
            total = int(answer.headers.get("Content-Length", 0))
            bar = log.progress(f"downloading {target.name}", total)
            with Path(output_file).open("wb") as file, bar as progress:
                for chunk in answer.iter_content(1 << 16):
                    file.write(chunk)
                    progress.advance(len(chunk))

    pooch.get_logger().setLevel("WARNING")
    try:
        pooch.retrieve(address, sha256, target.name, target.parent, downloader=download)
    except requests.RequestException as error:
        # The message of a lost connection is that of four nested exceptions.
        offline = type(error) in (requests.ConnectionError, requests.ConnectTimeout)
        why = "no connection" if offline else error
        raise Unavailable(f"the download of {address} failed ({why})") from error
    except ValueError as error:  # from pooch, which has deleted the file
        raise Unavailable(f"the download of {address} is damaged: {error}") from error
    return target
