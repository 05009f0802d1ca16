"""The check of a NeRF-Synthetic copy against the list of the release."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.scenes import integrity
from bench.types import SteerbenchError
from tests.bench.scenes.releases import publish

FILES = {"chair/train/r_0.png": b"a", "chair/test/r_0.png": b"b", "mic/train/r_0.png": b"c"}


@pytest.fixture
def release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A release of three files, and its list."""
    for name, content in FILES.items():
        path = tmp_path / "release" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    publish(monkeypatch, FILES)
    return tmp_path / "release"


def test_a_true_copy_passes(release, log) -> None:
    report = integrity.verify(release, log)
    assert sorted(report.ok) == sorted(FILES)
    assert (report.wrong, report.missing, report.extra) == ([], [], [])
    assert report.passed
    assert str(report) == "3 ok, 0 wrong, 0 missing, 0 extra"
    assert log.done == 3


def test_every_difference_is_named(release, log) -> None:
    (release / "chair/train/r_0.png").write_bytes(b"other")
    (release / "chair/test/r_0.png").unlink()
    (release / "mic/notes.txt").write_text("mine")
    report = integrity.verify(release, log)
    assert report.ok == ["mic/train/r_0.png"]
    assert report.wrong == ["chair/train/r_0.png"]
    assert report.missing == ["chair/test/r_0.png"]
    assert report.extra == ["mic/notes.txt"]
    assert not report.passed


def test_one_scene_is_checked_alone(release, log) -> None:
    report = integrity.verify(release / "chair", log)
    assert str(report) == "2 ok, 0 wrong, 0 missing, 0 extra"


def test_a_link_out_of_the_copy_is_not_followed(release, tmp_path, log) -> None:
    outside = tmp_path / "outside.png"
    (release / "mic/train/r_0.png").rename(outside)
    (release / "mic/train/r_0.png").symlink_to(outside)
    assert integrity.verify(release, log).missing == ["mic/train/r_0.png"]


def test_another_folder_is_refused(tmp_path, log) -> None:
    (tmp_path / "holidays").mkdir()
    with pytest.raises(SteerbenchError, match=r"holidays: expected a folder chair"):
        integrity.verify(tmp_path / "holidays", log)
