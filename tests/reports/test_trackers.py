"""What experiment trackers have of a run, read back with their own means. Nothing leaves the
machine; a tracker that is not installed is not tested."""

from __future__ import annotations

import pytest

from bench.errors import SteerbenchError, Unavailable
from reports import trackers
from reports.runs import load
from reports.trackers import headline, pictures, series, tracker


@pytest.fixture
def run(store, stored_run):
    (run,) = load(store, {stored_run: "grey"})
    return run


def test_tensorboard_has_the_figures_of_every_frame_and_of_the_run(run, tmp_path):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for _ in range(2):  # what was written once is kept
        tracker("tensorboard").send(run, tmp_path)
    events = EventAccumulator(str(tmp_path / "tensorboard" / run.key))
    events.Reload()
    for name, value in headline(run).items():
        assert [event.value for event in events.Scalars(f"run/{name}")] == [pytest.approx(value)]
    psnr = {frame: figures["psnr"] for frame, figures in series(run)}
    sent = {event.step: event.value for event in events.Scalars("frame/psnr")}
    assert sent == pytest.approx(psnr)
    assert set(events.Tags()["images"]) == {name for name, _ in pictures(run)}


def test_mlflow_has_one_run_of_a_key_with_its_figures(run, tmp_path, monkeypatch):
    mlflow = pytest.importorskip("mlflow")
    monkeypatch.setenv("MLFLOW_ALLOW_FILE_STORE", "true")
    mlflow.set_tracking_uri(f"file:{tmp_path}/mlruns")
    for _ in range(2):
        tracker("mlflow").send(run, tmp_path)
    (sent,) = mlflow.search_runs(experiment_names=["steerbench"], output_format="list")
    assert sent.data.tags["steerbench.run"] == run.key
    assert sent.data.params["command"] == run.record["command"]
    for name, value in headline(run).items():
        assert sent.data.metrics[name.replace("/", ".")] == pytest.approx(value)
    psnr = mlflow.MlflowClient().get_metric_history(sent.info.run_id, "frame.psnr")
    assert {x.step: x.value for x in psnr} == {i: x["psnr"] for i, x in series(run)}
    names = mlflow.artifacts.list_artifacts(run_id=sent.info.run_id, artifact_path="pictures")
    assert len(names) == len(list(pictures(run)))


def test_wandb_has_a_run_whose_id_is_the_key(run, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    tracker("wandb").send(run, tmp_path)
    (path,) = tmp_path.glob(f"wandb/offline-run-*/run-{run.key}.wandb")
    content = path.read_bytes()
    for name in ("psnr", "frame_ms", run.record["commit"], *(name for name, _ in pictures(run))):
        assert name.encode() in content
    assert len(list(tmp_path.rglob("files/media/images/**/*.png"))) == len(list(pictures(run)))


def test_an_unknown_tracker_and_one_that_is_not_installed_are_one_line(monkeypatch):
    with pytest.raises(SteerbenchError, match="expected one of wandb, mlflow, tensorboard"):
        tracker("comet")
    monkeypatch.setattr(trackers, "find_spec", lambda name: None)
    with pytest.raises(Unavailable, match=r"pip install .*\[wandb\]"):
        tracker("wandb")
