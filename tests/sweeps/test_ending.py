"""How a run ends that does not end by itself."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest


@pytest.fixture
def hanging(spawn, tmp_path):
    """A run that is in the middle of its training."""
    (tmp_path / "hang").touch()
    process = spawn()
    try:
        assert process.stderr.readline() == "hanging\n"
        (tmp_path / "hang").unlink()
        yield process
    finally:
        process.kill()
        process.communicate()


def runs(tmp_path: Path) -> list[str]:
    """Everything in the store, whole or not."""
    return [path.name for path in tmp_path.glob("outputs/runs/*")]


@pytest.mark.parametrize(
    ("sent", "status", "said"),
    [(signal.SIGTERM, 143, ""), (signal.SIGINT, 130, "steerbench: interrupted\n")],
)
def test_a_signal_ends_a_run_through_its_clean_up(hanging, tmp_path, sent, status, said):
    hanging.send_signal(sent)
    out, err = hanging.communicate()
    assert (hanging.returncode, out, err) == (status, "", said)
    assert len(list(tmp_path.glob("outputs/stages/*/cleaned-up"))) == 1
    assert runs(tmp_path) == []


def test_a_run_that_was_killed_can_be_run_again(hanging, run, tmp_path):
    hanging.kill()
    hanging.wait()
    assert runs(tmp_path) == []
    outcome = run()
    assert outcome.status == 0
    assert "6.05" in outcome.out
    assert len(runs(tmp_path)) == 1


@pytest.mark.slow
def test_a_reader_that_goes_away_ends_the_run_quietly(spawn):
    process = spawn()
    process.stdout.close()
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait() == 141
