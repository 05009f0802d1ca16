"""Of several processes one has a lock, and a killed one has none; what is missing is made once."""

import fcntl
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from bench.errors import SteerbenchError
from bench.sharing import check_sums, locked, missing, whole, write_sums

MAKER = """
import sys
from pathlib import Path
from bench.console import ConsoleLog
from bench.sharing import missing

class Printed(ConsoleLog):
    def info(self, message):
        print(message, flush=True)

path = Path(sys.argv[1])
with missing(path, Printed(path.parent)) as to_make:
    print("to make" if to_make else "there", flush=True)
    sys.stdin.readline()
    path.touch()
"""


def test_a_file_that_two_write_at_a_time_is_whole_at_any_time(tmp_path):
    path = tmp_path / "page.md"
    with whole(path) as one, whole(path) as other:
        assert one != other
        assert one.suffix == other.suffix == ".md"
        one.write_text("one")
        other.write_text("other")
        assert not path.exists()
    assert path.read_text() == "one"  # which ended last
    assert [path.name for path in tmp_path.iterdir()] == ["page.md"]


@pytest.mark.parametrize("exception", [ValueError, KeyboardInterrupt])
def test_a_file_that_is_not_ended_leaves_the_earlier_one_and_nothing_else(tmp_path, exception):
    path = tmp_path / "page.md"
    path.write_text("earlier")

    def write() -> None:
        with whole(path) as new:
            new.write_text("half")
            raise exception

    with pytest.raises(exception):
        write()
    assert path.read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["page.md"]


@pytest.mark.parametrize(("killed", "then"), [(False, "there"), (True, "to make")])
def test_of_two_processes_the_second_waits_for_the_first_or_its_end(tmp_path, killed, then):
    command = [sys.executable, "-c", MAKER, str(tmp_path / "made")]
    how = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **how) as first:
        assert first.stdout.readline() == "to make\n"
        with subprocess.Popen(command, **how) as second:
            assert "waits for another process that makes the same" in second.stdout.readline()
            first.kill() if killed else first.communicate("go on\n")
            assert second.stdout.readline() == f"{then}\n"
            second.communicate("go on\n")


def test_every_user_can_open_a_lock_whatever_the_umask(tmp_path, monkeypatch, log):
    before = os.umask(0o077)
    try:
        with locked(tmp_path / "lock", "", log):
            pass
    finally:
        os.umask(before)
    assert (tmp_path / "lock").stat().st_mode & 0o777 == 0o666
    system_open = os.open

    def opened(path: Path, flags: int, *mode: int) -> int:
        """As for another user, whom the system refuses O_CREAT in a folder for everybody."""
        if flags & os.O_CREAT and not flags & os.O_EXCL:
            raise PermissionError(13, "Permission denied", str(path))
        return system_open(path, flags, *mode)

    monkeypatch.setattr(os, "open", opened)
    with locked(tmp_path / "lock", "", log):
        pass


@pytest.mark.parametrize("held", [False, True])
def test_without_locks_in_the_file_system_the_work_is_done_all_the_same(
    tmp_path, monkeypatch, log, held
):
    """Also if the system first says that another process has the lock."""

    def refuse(handle: int, kind: int) -> None:
        if held and kind & fcntl.LOCK_NB:
            raise BlockingIOError
        raise OSError(37, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with missing(tmp_path / "made", log) as to_make:
        assert to_make
    assert re.search("not locked.*No locks available", log.messages[-1])


def test_what_is_there_needs_no_lock_and_a_folder_that_cannot_be_written_is_named(tmp_path, log):
    (tmp_path / "made").touch()
    with missing(tmp_path / "made", log) as to_make:
        assert not to_make
    assert [path.name for path in tmp_path.iterdir()] == ["made"]
    with pytest.raises(SteerbenchError, match="gone"), missing(tmp_path / "gone" / "x", log):
        pass


@pytest.mark.parametrize("change", ["content", "gone", "sums"])
def test_a_file_that_is_not_as_it_was_written_is_named(tmp_path, change):
    inner = tmp_path / "a folder" / "wei ght.bin"
    inner.parent.mkdir()
    inner.write_bytes(b"weights")
    (tmp_path / "other.txt").write_text("other")
    write_sums(tmp_path)
    check_sums(tmp_path)
    told = subprocess.run(["sha256sum", "--check", "--quiet", "SHA256SUMS"], cwd=tmp_path)
    assert told.returncode == 0
    if change == "content":
        inner.write_bytes(b"weightz")
    elif change == "gone":
        inner.unlink()
    else:
        (tmp_path / "SHA256SUMS").unlink()
    said = (
        "SHA256SUMS: expected checksums" if change == "sums" else "bin: damaged, or changed since"
    )
    with pytest.raises(SteerbenchError, match=said):
        check_sums(tmp_path)
    if change != "sums":
        check_sums(tmp_path, ["other.txt"])  # alone


def test_a_file_that_nobody_summed_does_not_pass(tmp_path):
    write_sums(tmp_path)
    (tmp_path / "late.txt").touch()
    for name in ("late.txt", "never.txt"):
        with pytest.raises(SteerbenchError, match=f"{name}: damaged"):
            check_sums(tmp_path, [name])
