"""The store shows whole runs only, and gives back exactly what was put in."""

import errno
import math
import os
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from bench import results
from bench.results import COLUMNS, SCHEMA_VERSION, STEADY, Measurement, Store, content_key
from bench.types import SteerbenchError
from reports.runs import read_picture

PICTURE = Path("pictures/0000-truth.png")


def measurement(values: list[float], text: str = "plain") -> Measurement:
    """One row per value; every column of text holds `text`."""
    metrics = [f"metric_{i}" for i in range(len(values))]
    figures = {"n": 1, "lo": math.nan, "hi": math.nan, "seed": 0}
    words = dict.fromkeys(set(COLUMNS) - {"run", "commit", "metric", "value", *figures}, text)
    rows = pd.DataFrame({"metric": metrics, "value": values, **figures, **words})
    frames = pd.DataFrame(
        {"frame": [0, 1], "name": ["007", "NA"], "phase": STEADY, "psnr": [30.25, math.nan]}
    )
    picture = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    return Measurement(rows, frames, {"0000-truth": picture}, {"note": "as measured"})


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "outputs")


def test_parts_that_do_not_repeat_are_refused():
    with pytest.raises(ValueError, match="not JSON compliant"):
        content_key({"rate": math.nan})
    with pytest.raises(TypeError, match="not JSON serializable"):
        content_key({"scene": object()})


def test_a_saved_run_is_found_with_its_rows_frames_record_and_pictures(store):
    saved = measurement([1.5, math.nan])
    key = store.save({"seed": 0}, saved)
    assert key == store.key({"seed": 0})
    folder = store.find(key)
    assert sorted(path.name for path in folder.iterdir()) == [
        *("SHA256SUMS", "frames.csv", "pictures", "record.json", "rows.csv")
    ]
    rows = store.rows()
    assert set(rows["run"]) == {key}
    assert rows["metric"].tolist() == ["metric_0", "metric_1"]
    pd.testing.assert_frame_equal(store.frames(key), saved.frames)
    record = store.record(key)
    assert record["made_of"] == {"seed": 0}
    assert record["note"] == "as measured"
    with Image.open(folder / "pictures" / "0000-truth.png") as picture:
        assert np.array_equal(np.asarray(picture), saved.pictures["0000-truth"])


TEXTS = ["12e4567", "007", "nan", "NA", "", 'a "quoted", comma\nand line']


@given(st.lists(st.floats(width=64), min_size=1), st.sampled_from(TEXTS))
def test_values_come_back_bit_for_bit_and_text_stays_text(tmp_path_factory, values, text):
    store = Store(tmp_path_factory.mktemp("outputs"))
    store.save({}, measurement(values, text))
    rows = store.rows()
    np.testing.assert_array_equal(rows["value"].to_numpy(), values)
    assert set(rows["method"]) == set(rows["precision"]) == {text}


@pytest.mark.parametrize("exception", [ValueError, KeyboardInterrupt])
def test_a_run_that_is_interrupted_leaves_nothing(store, exception):
    def write() -> None:
        with store.write("abc") as folder:
            (folder / "record.json").write_text("{}")
            raise exception

    with pytest.raises(exception):
        write()
    assert list(store.folder.iterdir()) == []


def test_what_is_left_of_a_run_that_was_half_deleted_is_replaced(store):
    key = store.save({"seed": 0}, measurement([1.0]))
    (store.folder / key / "record.json").unlink()
    assert store.find(key) is None
    assert store.save({"seed": 0}, measurement([2.0])) == key
    assert store.rows()["value"].tolist() == [2.0]


@pytest.mark.parametrize("wanted", ["{key}", "{start}", "{folder}/{key}"])
def test_a_run_is_found_by_the_beginning_of_its_key_or_by_its_folder(store, wanted):
    key = store.save({"seed": 0}, measurement([1.0]))
    folder = store.folder.resolve()
    assert store.whole_key(wanted.format(key=key, start=key[:5], folder=folder)) == key
    with pytest.raises(SteerbenchError, match="0 runs"):
        store.whole_key(f"{key}0")
    for read in (store.frames, store.record):
        with pytest.raises(SteerbenchError, match="no run 'abc' in"):
            read("abc")


def test_of_two_processes_with_the_same_run_the_first_to_finish_stays(store):
    with store.write("abc") as late:
        (late / "record.json").write_text('{"by": "late"}')
        assert store.find("abc") is None  # not before it is whole
        assert store.rows().empty
        with store.write("abc") as early:
            (early / "record.json").write_text('{"by": "early"}')
    assert store.record("abc") == {"by": "early"}
    assert [path.name for path in store.folder.iterdir()] == ["abc"]


def test_what_a_killed_process_left_is_ignored_and_deleted_after_a_day(store):
    store.folder.mkdir(parents=True)
    fresh, stale = store.folder / ".partial-abc-1", store.folder / ".partial-def-2"
    for folder in (fresh, stale):
        folder.mkdir()
        (folder / "record.json").write_text("{}")
    before = time.time() - results.STALE_S - 60
    os.utime(stale, (before, before))
    assert store.rows().empty
    store.save({}, measurement([1.0]))
    assert fresh.exists()
    assert not stale.exists()
    (store.folder / ".partial-abc-0").symlink_to("published")  # listed, and gone when looked at
    assert store.find(store.save({"seed": 1}, measurement([1.0])))


def test_runs_of_another_schema_are_reported_in_one_line_and_left_out(store):
    assert list(store.rows().columns) == COLUMNS
    keys = [store.save({"seed": i}, measurement([i, 2.0])) for i in range(5)]
    assert store.rows()["run"].value_counts().to_dict() == dict.fromkeys(keys, 2)
    *kept, one, two, damaged = keys
    now = f'"schema_version": {SCHEMA_VERSION}'
    for foreign in (one, two):
        record = store.folder / foreign / "record.json"
        record.write_text(record.read_text().replace(now, '"schema_version": 99'))
    (store.folder / damaged / "record.json").write_text("{")
    reports: list[str] = []
    assert set(store.rows(report=reports.append)["run"]) == {*kept}
    assert len(reports) == 2
    both = f"{min(one, two)}, {max(one, two)}: stored by another version"
    assert any(both in line and "schema 99" in line for line in reports)
    assert any(damaged in line for line in reports)


@pytest.mark.parametrize(
    ("file", "read"),
    [
        ("rows.csv", lambda store, key: store.rows(pytest.fail)),
        ("frames.csv", Store.frames),
        ("record.json", Store.record),
        ("pictures/0000-truth.png", lambda store, key: read_picture(store.find(key) / PICTURE)),
    ],
)
def test_a_file_of_a_run_that_was_changed_is_refused_by_whatever_reads_it(store, file, read):
    key, kept = (store.save({"seed": i}, measurement([i])) for i in range(2))
    read(store, key)
    assert store.intact(key)
    path = store.find(key) / file
    content = path.read_bytes()
    path.write_bytes(content.replace(b"3", b"4", 1) if b"3" in content else content[:-1])
    assert not store.intact(key)
    with pytest.raises(
        (SteerbenchError, pytest.fail.Exception), match=f"{file}: damaged, or changed"
    ):
        read(store, key)
    read(store, kept) if file != "rows.csv" else None


def test_a_run_in_the_folder_of_another_is_left_out(store):
    key = store.save({"seed": 0}, measurement([1.0]))
    (store.folder / key).rename(store.folder / "other")
    reports: list[str] = []
    assert store.rows(reports.append).empty
    assert f"expected the run that its folder is named after, got {key}" in reports[0]


def test_a_run_knows_when_and_by_which_jobs_it_was_asked_for(store):
    key = store.save({"seed": 0}, measurement([1.0]))
    assert store.used(key) == (0.0, [])
    before = time.time()
    store.use(key, "b")
    store.use(key, "a", "b")
    used, jobs = store.used(key)
    assert jobs == ["a", "b"]
    assert used >= before
    assert store.intact(key)


def test_a_disk_that_refuses_is_a_clear_error_and_leaves_nothing(store, monkeypatch):
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    monkeypatch.setattr(os, "fsync", Mock(side_effect=full))
    said = f"cannot write to .*outputs.*{full.strerror}.*outputs=DIR"
    with pytest.raises(SteerbenchError, match=said):
        store.save({}, measurement([1.0]))
    assert list(store.folder.iterdir()) == []
