"""Published data sets: their lists, and what a download leaves behind. The server is a stand-in."""

from __future__ import annotations

import io
import zipfile

import pytest

from bench.scenes.published import get, published
from bench.types import Unavailable
from tests.bench.scenes.releases import publish

FILES = {"mic/train/r_0.png": b"a", "mic/test/r_0.png": b"b", "mic/test/r_0_depth_0000.png": b"c"}


def test_the_list_of_nerf_synthetic_is_the_whole_release() -> None:
    official = next(data for data in published() if data.name == "nerf_synthetic")
    scenes = {"chair", "drums", "ficus", "hotdog", "lego", "materials", "mic", "ship"}
    assert official.scenes == scenes
    for scene in scenes:
        for split, count in (("train", 100), ("val", 100), ("test", 200)):
            pictures = {f"{scene}/{split}/r_{k}.png" for k in range(count)}
            assert pictures | {f"{scene}/transforms_{split}.json"} <= official.of(scene).keys()
    assert all(len(digest) == 64 for digest in official.hashes.values())


def test_a_copy_of_fox_has_the_checksums_of_its_list(shared_data) -> None:
    if shared_data is None:
        pytest.skip("no data")
    from bench.scenes.integrity import verify
    from tests.bench.scenes.conftest import RememberingLog

    report = verify(shared_data / "fox", RememberingLog())
    assert (report.passed, report.wrong, report.missing, report.extra) == (True, [], [], [])


def zipped(files: dict[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


def found(folder) -> dict[str, bytes]:
    """The files of a scene by their paths."""
    paths = [path for path in (folder / "mic").rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def test_a_scene_is_unpacked_and_only_what_is_on_the_list(monkeypatch, web, tmp_path, log) -> None:
    data = publish(monkeypatch, FILES, archive=web.address + "{scene}.zip")
    web.files["/mic.zip"] = zipped(FILES | {"../evil": b"!", "mic/notes.txt": b"mine"})
    assert get(data, "mic", tmp_path / "data", log) == tmp_path / "data" / "mic"
    assert found(tmp_path / "data") == FILES
    assert {path.name for path in (tmp_path / "data").iterdir()} == {"mic", ".lock"}

    get(data, "mic", tmp_path / "data", log)
    assert len(web.asked) == 1


def test_an_archive_may_lack_depths(monkeypatch, web, tmp_path, log) -> None:
    data = publish(monkeypatch, FILES, archive=web.address + "{scene}.zip")
    pictures = {name: content for name, content in FILES.items() if "depth" not in name}
    web.files["/mic.zip"] = zipped(pictures)
    get(data, "mic", tmp_path, log)
    assert found(tmp_path) == pictures


@pytest.mark.parametrize(
    "archive",
    [
        b"not a zip file",
        zipped(FILES | {"mic/train/r_0.png": b"other"}),
        zipped({"mic/test/r_0.png": b"b"}),
    ],
    ids=["no archive", "another picture", "a picture missing"],
)
def test_a_wrong_archive_leaves_nothing_behind(monkeypatch, web, tmp_path, log, archive) -> None:
    data = publish(monkeypatch, FILES, archive=web.address + "{scene}.zip")
    web.files["/mic.zip"] = archive
    with pytest.raises(Unavailable, match=r"mic.zip: expected"):
        get(data, "mic", tmp_path, log)
    assert {path.name for path in tmp_path.iterdir()} == {".lock"}


def test_of_single_files_the_wrong_ones_are_fetched_again(monkeypatch, web, tmp_path, log) -> None:
    data = publish(monkeypatch, FILES, folder=web.address)
    web.files = {f"/{name}": content for name, content in FILES.items()}
    get(data, "mic", tmp_path, log)
    assert found(tmp_path) == FILES
    (tmp_path / "mic/train/r_0.png").write_bytes(b"damaged")
    web.asked.clear()
    get(data, "mic", tmp_path, log)
    assert found(tmp_path) == FILES
    assert web.asked == [("/mic/train/r_0.png", 0)]
