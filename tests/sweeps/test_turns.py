"""Jobs take turns on a device, and sweeps run through Hydra's launchers as they do without."""

from __future__ import annotations

import queue
import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from bench.console import ConsoleLog
from sweeps import turns
from sweeps.turns import lock_file, turn

PATIENCE_S = 60.0
"""A test that waits longer has failed."""


class Told(ConsoleLog):
    """A log that hands on what it is told."""

    def __init__(self, root: Path) -> None:
        super().__init__(root, quiet=True)
        self.messages: queue.Queue[str] = queue.Queue()

    def info(self, message: str) -> None:
        self.messages.put(message)


@pytest.fixture(autouse=True)
def locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(turns.FOLDER, str(tmp_path))


def waiting(outputs: Path, device: str) -> tuple[threading.Thread, Told, threading.Event]:
    """Somebody else who wants a turn: what they are told, and whether they had it."""
    log, had = Told(outputs), threading.Event()

    def other() -> None:
        with turn(device, log):
            had.set()

    thread = threading.Thread(target=other, daemon=True)
    thread.start()
    return thread, log, had


def test_who_wants_a_device_that_is_taken_waits_for_it(tmp_path: Path) -> None:
    with turn("cpu", Told(tmp_path)):
        thread, log, had = waiting(tmp_path / "elsewhere", "cpu")
        assert "waiting: another process measures on cpu" in log.messages.get(timeout=PATIENCE_S)
        assert not had.is_set()
    thread.join(PATIENCE_S)
    assert had.is_set()


def test_a_failure_ends_the_turn(tmp_path: Path) -> None:
    with pytest.raises(KeyError), turn("cpu", Told(tmp_path)):
        raise KeyError
    thread, _, had = waiting(tmp_path, "cpu")
    thread.join(PATIENCE_S)
    assert had.is_set()


def test_graphics_processors_are_told_apart_by_what_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {"cuda:0": "GPU-a", "cuda:1": "GPU-b"}
    monkeypatch.setattr(
        torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid=names[device])
    )
    first, second = map(lock_file, names)
    assert first != second
    names["cuda:0"] = "GPU-b"  # as another job counts them
    assert lock_file("cuda:0") == second


def test_locks_lie_where_every_job_and_user_of_the_machine_sees_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(turns.FOLDER)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "of this job"))
    assert lock_file("cpu").parent == Path("/var/tmp")


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_a_launcher_runs_every_job_and_tells_of_those_that_fail(spawn, launcher: str) -> None:
    plugin = f"hydra_{launcher.partition('_')[0]}_launcher"
    pytest.importorskip(f"hydra_plugins.{plugin}", reason=f"{plugin} is an extra")
    process = spawn("-m", "method.level=0.3,0.6,7", f"hydra/launcher={launcher}")
    out, err = process.communicate()
    assert process.returncode == 2, err
    for cell in ("3.07", "7.96", "level=7): failed: method.level: expected 0 to 1"):
        assert cell in out
