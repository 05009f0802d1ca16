"""What a person sees on standard error, and where trained stages go."""

import re
import threading
from types import SimpleNamespace

import pytest

from bench.console import ConsoleLog
from tests.common import refusal


@pytest.fixture
def clock() -> SimpleNamespace:
    return SimpleNamespace(now=1000.0)


@pytest.fixture
def plain(monkeypatch, tmp_path, clock) -> ConsoleLog:
    """A log without a terminal."""
    for variable in ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
        monkeypatch.delenv(variable, raising=False)
    return ConsoleLog(tmp_path, clock=lambda: clock.now)


def test_messages_go_to_standard_error_as_they_are(plain, capsys):
    plain.info("[bold]not markup[/bold] " + "x" * 200)
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "[bold]not markup[/bold] " + "x" * 200 + "\n"


def test_without_a_terminal_a_line_every_ten_seconds_tells_the_time_left(plain, clock, capsys):
    with plain.progress("training", 100) as bar:
        for _ in range(50):
            clock.now += 1.0
            bar.advance(1, note="31.2 dB")
        lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert lines[1] == "training: 20 %, 0:00:20 elapsed, 0:01:20 left, 31.2 dB"
    assert capsys.readouterr().err == "training: done in 0:00:50, 31.2 dB\n"


def test_work_that_fails_or_is_short_is_not_called_done_and_the_next_is(plain, clock, capsys):
    with plain.progress("short work", 10):
        clock.now += 1.0
    work = plain.progress("training", 10)
    work.__enter__()
    clock.now += 60.0
    assert not work.__exit__(KeyError, KeyError(), None)
    with plain.progress("again", 10) as bar:
        clock.now += 5.0
        bar.advance(10)
    assert capsys.readouterr().err == "again: done in 0:00:05\n"


def test_a_quiet_log_says_nothing_but_to_who_follows_it(tmp_path, clock, capsys):
    log, told = ConsoleLog(tmp_path, quiet=True, clock=lambda: clock.now), []
    log.followers.append(told.append)
    log.info("hello")
    with log.progress("training", 10) as bar:
        clock.now += 60.0
        bar.advance(5)
    assert capsys.readouterr() == ("", "")
    assert told[0].startswith("training: 50 %, 0:01:00 elapsed")


def test_on_a_terminal_nested_bars_show_how_far_it_is_without_a_thread(
    monkeypatch, tmp_path, clock, capsys
):
    kind = {"TTY_COMPATIBLE": "1", "TTY_INTERACTIVE": "1", "TERM": "xterm", "COLUMNS": "120"}
    for variable, value in kind.items():
        monkeypatch.setenv(variable, value)
    terminal = ConsoleLog(tmp_path, clock=lambda: clock.now)
    before = threading.active_count()
    with terminal.progress("outer [1]", 2) as outer:
        assert threading.active_count() == before
        with terminal.progress("inner", 4) as inner:
            for _ in range(3):
                clock.now += 2.0
                inner.advance(1, note="[x] 9 dB")
        outer.advance()
    shown = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().err)
    assert "outer [1]" in shown
    assert re.search(r"inner .* 75% 0:00:06 0:00:02 \[x\] 9 dB", shown)
    assert "inner: done in 0:00:06, [x] 9 dB" in shown


def test_a_stage_has_one_folder_for_one_key_in_any_order(plain, tmp_path):
    folder = plain.stage_dir("field", {"steps": 10, "seed": 0})
    assert folder.is_dir()
    assert re.fullmatch(r"field-[0-9a-f]{12}", folder.name)
    assert folder.parent == tmp_path / "stages"
    assert plain.stage_dir("field", {"seed": 0, "steps": 10}) == folder
    assert plain.stage_dir("field", {"seed": 1, "steps": 10}) != folder
    (tmp_path / "outputs").write_text("in the way")
    with refusal(r"cannot write to .*outputs"):
        ConsoleLog(tmp_path / "outputs").stage_dir("field", {})
