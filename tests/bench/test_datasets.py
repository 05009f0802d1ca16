"""Data sets of others: downloads that break off or lie, copies that differ.

The publisher is a server on the loopback address.
"""

import hashlib
import io
import socket
import zipfile
from collections.abc import Mapping
from pathlib import Path

import pytest

from bench import datasets
from bench.datasets import Published, get, verify
from bench.download import fetch
from bench.types import Unavailable
from sweeps.commands import scenes
from tests.common import refusal

CONTENT = bytes(range(256)) * 600
FILES = {"mic/train/r_0.png": b"a", "mic/test/r_0.png": b"b", "mic/test/r_0_depth_0000.png": b"c"}


def publish(monkeypatch: pytest.MonkeyPatch, files: Mapping[str, bytes], **where: str) -> Published:
    """A data set of these files by their paths, the only one that is known."""
    data = Published("release", "blender", "free", **where)
    hashes = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    data.__dict__["hashes"] = hashes  # as if they had been read
    for module in (datasets, scenes):
        monkeypatch.setattr(module, "published", lambda: [data])
    return data


def found(folder: Path) -> dict[str, bytes]:
    paths = [path for path in folder.rglob("*") if path.is_file() and path.name != ".lock"]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def zipped(files: dict[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


@pytest.mark.parametrize(
    ("files", "end", "said"),
    [
        ({"/file": CONTENT}, 100_000, r"the download of http://127.0.0.1:\d+/file failed"),
        ({"/file": CONTENT[::-1]}, None, "is damaged"),
        ({}, None, r"/file failed \(404"),
    ],
    ids=["broken off", "another content", "not there"],
)
def test_a_failed_download_says_why_and_leaves_nothing(web, tmp_path, quiet_log, files, end, said):
    web.files |= files
    web.breaks_after = end
    digest = hashlib.sha256(CONTENT).hexdigest()
    with refusal(said, Unavailable):
        fetch(web.address + "file", tmp_path / "file", digest, quiet_log)
    assert found(tmp_path) == {}


def test_without_a_connection_the_message_says_so_in_two_words(tmp_path, quiet_log):
    nobody = socket.create_server(("127.0.0.1", 0))
    address = f"http://127.0.0.1:{nobody.getsockname()[1]}/file"
    nobody.close()
    with refusal(r"/file failed \(no connection\)$", Unavailable):
        fetch(address, tmp_path / "file", None, quiet_log)


def test_the_list_of_nerf_synthetic_is_the_whole_release():
    official = next(data for data in datasets.published() if data.name == "nerf_synthetic")
    scenes = {"chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"}
    assert official.scenes == scenes
    for scene in scenes:
        for split, count in (("train", 100), ("val", 100), ("test", 200)):
            pictures = {f"{scene}/{split}/r_{k}.png" for k in range(count)}
            assert pictures | {f"{scene}/transforms_{split}.json"} <= official.of(scene).keys()
    assert all(len(digest) == 64 for digest in official.hashes.values())


def test_a_copy_of_fox_has_the_checksums_of_its_list(shared_data, quiet_log):
    if shared_data is None:
        pytest.skip("no data")
    report = verify(shared_data / "fox", quiet_log)
    assert (report.passed, report.wrong, report.missing, report.extra) == (True, [], [], [])


def test_a_scene_is_unpacked_and_only_what_is_on_the_list(monkeypatch, web, tmp_path, quiet_log):
    data = publish(monkeypatch, FILES, archive=web.address + "{scene}.zip")
    web.files["/mic.zip"] = zipped(FILES | {"../evil": b"!", "mic/notes.txt": b"mine"})
    for _ in range(2):
        assert get(data, "mic", tmp_path / "data", quiet_log) == tmp_path / "data/mic"
        assert found(tmp_path) == {f"data/{name}": content for name, content in FILES.items()}
    assert len(web.asked) == 1
    pictures = {name: content for name, content in FILES.items() if "depth" not in name}
    web.files["/mic.zip"] = zipped(pictures)  # an archive may lack depths
    get(data, "mic", tmp_path / "without", quiet_log)
    assert found(tmp_path / "without") == pictures


WRONG = {
    "no archive": b"not a zip file",
    "another picture": zipped(FILES | {"mic/train/r_0.png": b"other"}),
    "a picture missing": zipped({"mic/test/r_0.png": b"b"}),
}


@pytest.mark.parametrize("archive", WRONG.values(), ids=WRONG)
def test_a_wrong_archive_leaves_nothing_behind(monkeypatch, web, tmp_path, quiet_log, archive):
    data = publish(monkeypatch, FILES, archive=web.address + "{scene}.zip")
    web.files["/mic.zip"] = archive
    with refusal(r"mic.zip: expected", Unavailable):
        get(data, "mic", tmp_path, quiet_log)
    assert found(tmp_path) == {}


def test_of_single_files_the_wrong_ones_are_fetched_again(monkeypatch, web, tmp_path, quiet_log):
    data = publish(monkeypatch, FILES, folder=web.address)
    web.files = {f"/{name}": content for name, content in FILES.items()}
    get(data, "mic", tmp_path, quiet_log)
    assert found(tmp_path) == FILES
    (tmp_path / "mic/train/r_0.png").write_bytes(b"damaged")
    web.asked.clear()
    get(data, "mic", tmp_path, quiet_log)
    assert found(tmp_path) == FILES
    assert web.asked == ["/mic/train/r_0.png"]


def test_every_difference_is_named_and_no_link_out_is_followed(monkeypatch, tmp_path, quiet_log):
    files = {"chair/a.png": b"a", "chair/b.png": b"b", "mic/c.png": b"c"}
    publish(monkeypatch, files)
    release = tmp_path / "release"
    for name, content in files.items():
        (release / name).parent.mkdir(parents=True, exist_ok=True)
        (release / name).write_bytes(content)
    for part, count in ((".", 3), ("chair", 2)):  # a release, or a scene of it
        report = verify(release / part, quiet_log)
        assert str(report) == f"{count} ok, 0 wrong, 0 missing, 0 extra"
        assert report.passed
    (release / "chair/a.png").write_bytes(b"other")
    (release / "chair/b.png").unlink()
    (release / "mic/notes.txt").write_text("mine")
    report = verify(release, quiet_log)
    assert (report.ok, report.wrong) == (["mic/c.png"], ["chair/a.png"])
    assert (report.missing, report.extra) == (["chair/b.png"], ["mic/notes.txt"])
    assert not report.passed
    (release / "mic/c.png").rename(tmp_path / "outside.png")
    (release / "mic/c.png").symlink_to(tmp_path / "outside.png")
    assert verify(release, quiet_log).missing == ["chair/b.png", "mic/c.png"]
    with refusal(r"expected a folder chair"):
        verify(tmp_path, quiet_log)
