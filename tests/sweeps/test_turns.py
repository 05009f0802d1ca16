"""Jobs take turns on a device, and sweeps run through Hydra's launchers as they do without."""

from __future__ import annotations

import fcntl
from pathlib import Path

import pytest

from bench.console import ConsoleLog
from sweeps.turns import turn


def taken(lock: Path) -> bool:
    """Whether anybody holds `lock`."""
    with lock.open() as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def test_a_device_is_taken_as_long_as_the_turn_lasts(tmp_path: Path) -> None:
    log = ConsoleLog(tmp_path, quiet=True)
    with turn(tmp_path, "cpu", log), turn(tmp_path, "cuda:0", log):
        first, second = sorted((tmp_path / "locks").iterdir())
        assert taken(first)
        assert taken(second)
    assert not taken(first)


def test_graphics_processors_that_share_a_number_are_told_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = ConsoleLog(tmp_path, quiet=True)
    for visible in ("0", "1"):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
        with turn(tmp_path, "cuda:0", log):
            pass
    assert len(list((tmp_path / "locks").iterdir())) == 2


def test_a_failure_ends_the_turn(tmp_path: Path) -> None:
    with pytest.raises(KeyError), turn(tmp_path, "cpu", ConsoleLog(tmp_path, quiet=True)):
        raise KeyError
    (lock,) = (tmp_path / "locks").iterdir()
    assert not taken(lock)


@pytest.mark.parametrize("launcher", ["joblib", "submitit_local", "ray"])
def test_a_launcher_runs_every_job_and_tells_of_those_that_fail(spawn, launcher: str) -> None:
    plugin = f"hydra_{launcher.partition('_')[0]}_launcher"
    pytest.importorskip(f"hydra_plugins.{plugin}", reason=f"{plugin} is an extra")
    process = spawn("-m", "method.level=0.3,0.6,7", f"hydra/launcher={launcher}")
    out, err = process.communicate()
    assert process.returncode == 2, err
    for cell in ("3.07", "7.96", "level=7): failed: method.level: expected 0 to 1"):
        assert cell in out
