"""One process at a time measures on a device; sweeps run through Hydra's launchers alike."""

from __future__ import annotations

import queue
import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from bench.console import ConsoleLog
from sweeps import device_lock
from sweeps.device_lock import lock_file

PATIENCE_S = 60.0
"""A test that waits longer has failed."""


class Heard(ConsoleLog):
    """A log that keeps its messages in a queue."""

    def __init__(self, root: Path) -> None:
        super().__init__(root, quiet=True)
        self.messages: queue.Queue[str] = queue.Queue()

    def info(self, message: str) -> None:
        self.messages.put(message)


@pytest.fixture(autouse=True)
def locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(device_lock.FOLDER, str(tmp_path))


def waiting(outputs: Path, device: str) -> tuple[threading.Thread, Heard, threading.Event]:
    """A second thread that wants the lock: its log, and whether it had the lock."""
    log, had = Heard(outputs), threading.Event()

    def other() -> None:
        with device_lock.device_lock(device, log):
            had.set()

    thread = threading.Thread(target=other, daemon=True)
    thread.start()
    return thread, log, had


def test_a_device_that_is_locked_is_waited_for(tmp_path):
    with device_lock.device_lock("cpu", Heard(tmp_path)):
        thread, log, had = waiting(tmp_path / "elsewhere", "cpu")
        assert "waiting: another process measures on cpu" in log.messages.get(timeout=PATIENCE_S)
        assert not had.is_set()
    thread.join(PATIENCE_S)
    assert had.is_set()


def test_a_failure_releases_the_lock(tmp_path):
    with pytest.raises(KeyError), device_lock.device_lock("cpu", Heard(tmp_path)):
        raise KeyError
    thread, _, had = waiting(tmp_path, "cpu")
    thread.join(PATIENCE_S)
    assert had.is_set()


def test_gpus_are_told_apart_by_their_uuid(tmp_path, monkeypatch):
    names = {"cuda:0": "GPU-a", "cuda:1": "GPU-b"}
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid=names[device])
    )
    first, second = map(lock_file, names)
    assert first != second
    names["cuda:0"] = "GPU-b"  # as another job counts them
    assert lock_file("cuda:0") == second


def test_locks_lie_where_every_job_and_user_of_the_machine_sees_them(tmp_path, monkeypatch):
    monkeypatch.delenv(device_lock.FOLDER)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "of this job"))
    assert lock_file("cpu").parent == Path("/var/tmp")


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_a_launcher_runs_every_job_and_names_those_that_fail(spawn, launcher):
    plugin = f"hydra_{launcher.partition('_')[0]}_launcher"
    pytest.importorskip(f"hydra_plugins.{plugin}", reason=f"{plugin} is an extra")
    process = spawn("-m", "method.level=0.3,0.6,7", f"hydra/launcher={launcher}")
    out, err = process.communicate()
    assert process.returncode == 2, err
    for cell in ("3.07", "7.96", "level=7): failed: method.level: expected 0 to 1"):
        assert cell in out
