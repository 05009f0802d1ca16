"""A job that fails says why, whatever else goes wrong then."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.errors import SteerbenchError
from sweeps import attempt
from sweeps.overrides import composed


def test_a_failure_that_cannot_be_kept_is_told_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def obtain(*_: object) -> None:
        raise SteerbenchError("the cause")

    monkeypatch.setattr(attempt, "obtain", obtain)
    (tmp_path / "outputs").touch()  # no folder can be made there
    with pytest.raises(SteerbenchError, match="the cause"):
        attempt.attempt(composed([f"outputs={tmp_path / 'outputs'}"]), [], "a job")
    told = capsys.readouterr().err
    assert "failed: a job: the cause" in told
    assert "cannot write to" in told
