"""What experiment trackers have of a run, read back with their own means. Nothing leaves the
machine; a tracker that is not installed is not tested."""

from unittest.mock import Mock

import pytest

from bench.errors import SteerbenchError, Unavailable
from reports import trackers
from reports.trackers import headline, pictures, series, tracker


def test_tensorboard_has_the_figures_of_every_frame_and_of_the_run(run, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for _ in range(2):  # what was written once is kept
        tracker("tensorboard")(run, tmp_path)
    events = EventAccumulator(str(tmp_path / "tensorboard" / run.key))
    events.Reload()
    for name, value in headline(run).items():
        assert [event.value for event in events.Scalars(f"run/{name}")] == [pytest.approx(value)]
    psnr = {frame: figures["psnr"] for frame, figures in series(run)}
    sent = {event.step: event.value for event in events.Scalars("frame/psnr")}
    assert sent == pytest.approx(psnr)
    assert set(events.Tags()["images"]) == {name for name, _ in pictures(run)}


def test_an_interruption_leaves_nothing_that_looks_whole(run, tmp_path, monkeypatch):
    pytest.importorskip("tensorboard")
    with monkeypatch.context() as patch:
        patch.setattr(trackers, "pictures", Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            tracker("tensorboard")(run, tmp_path)
    assert not (tmp_path / "tensorboard" / run.key).exists()
    test_tensorboard_has_the_figures_of_every_frame_and_of_the_run(run, tmp_path)


def test_wandb_has_a_run_whose_id_is_the_key(run, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    tracker("wandb")(run, tmp_path)
    (path,) = tmp_path.glob(f"wandb/offline-run-*/run-{run.key}.wandb")
    content = path.read_bytes()
    for name in ("psnr", "frame_ms", run.record["commit"], *(name for name, _ in pictures(run))):
        assert name.encode() in content
    assert len(list(tmp_path.rglob("files/media/images/**/*.png"))) == len(list(pictures(run)))


def test_an_unknown_tracker_and_one_that_is_not_installed_are_one_line(monkeypatch):
    with pytest.raises(SteerbenchError, match="expected one of wandb, tensorboard"):
        tracker("comet")
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    with pytest.raises(Unavailable, match=r"pip install .*\[wandb\]"):
        tracker("wandb")
