"""Downloads from a server on the loopback address, as they should be and broken off."""

from __future__ import annotations

import hashlib
import socket
from pathlib import Path

import pytest

from bench.download import fetch
from bench.types import Unavailable
from tests.web import Web

CONTENT = bytes(range(256)) * 600
SHA256 = hashlib.sha256(CONTENT).hexdigest()


def download(web: Web, folder: Path, log) -> bytes:
    return fetch(web.address + "file", folder / "file", SHA256, log).read_bytes()


def test_what_is_there_and_right_is_not_downloaded_again(web, tmp_path, quiet_log):
    web.files["/file"] = CONTENT
    assert download(web, tmp_path, quiet_log) == CONTENT
    assert download(web, tmp_path, quiet_log) == CONTENT
    assert web.asked == [("/file", 0)]
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_download_goes_on_where_it_broke_off(web, tmp_path, quiet_log):
    web.files["/file"], web.breaks_after = CONTENT, 100_000
    with pytest.raises(Unavailable, match=r"the download of http://127.0.0.1:\d+/file failed"):
        download(web, tmp_path, quiet_log)
    assert not (tmp_path / "file").exists()
    web.breaks_after = None
    assert download(web, tmp_path, quiet_log) == CONTENT
    (_, first), (_, second) = web.asked
    assert first == 0 < second <= 100_000


def test_a_server_that_cannot_go_on_begins_again(web, tmp_path, quiet_log):
    web.files["/file"], web.breaks_after, web.continues = CONTENT, 100_000, False
    with pytest.raises(Unavailable):
        download(web, tmp_path, quiet_log)
    web.breaks_after = None
    assert download(web, tmp_path, quiet_log) == CONTENT


def test_a_file_that_became_shorter_meanwhile_is_fetched_anew(web, tmp_path, quiet_log):
    web.files["/file"], web.breaks_after = CONTENT * 2, len(CONTENT)
    with pytest.raises(Unavailable):
        download(web, tmp_path, quiet_log)
    web.files["/file"], web.breaks_after = CONTENT, None
    assert download(web, tmp_path, quiet_log) == CONTENT


def test_another_content_is_refused_and_not_kept(web, tmp_path, quiet_log):
    web.files["/file"] = CONTENT[::-1]
    with pytest.raises(Unavailable, match="is damaged"):
        download(web, tmp_path, quiet_log)
    assert not list(tmp_path.iterdir())


def test_without_a_connection_the_message_says_so_in_two_words(tmp_path, quiet_log):
    nobody = socket.create_server(("127.0.0.1", 0))
    address = f"http://127.0.0.1:{nobody.getsockname()[1]}/file"
    nobody.close()
    with pytest.raises(Unavailable, match=r"/file failed \(no connection\)$"):
        fetch(address, tmp_path / "file", None, quiet_log)


def test_a_file_that_is_not_there_is_named(web, tmp_path, quiet_log):
    with pytest.raises(Unavailable, match=r"/file failed \(404"):
        download(web, tmp_path, quiet_log)
