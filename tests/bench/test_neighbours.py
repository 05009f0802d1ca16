"""What other processes do beside a measurement, with accounts of the kernel that are made up."""

import subprocess
import sys
import time
from collections import namedtuple

import psutil
import pytest

from bench import neighbours
from bench.neighbours import Neighbours, Watch

Times = namedtuple("Times", "user system idle iowait steal guest")


@pytest.fixture
def accounts(monkeypatch):
    """The kernel's accounts, as a dictionary to change."""
    now = {"passed": 0.0, "own": 0.0, "times": Times(0, 0, 0, 0, 0, 0)}
    monkeypatch.setattr(psutil, "cpu_times", lambda: now["times"])
    monkeypatch.setattr(psutil, "cpu_count", lambda: 4)
    monkeypatch.setattr(time, "monotonic", lambda: now["passed"])
    monkeypatch.setattr(time, "process_time", lambda: now["own"])
    monkeypatch.setattr(neighbours, "NOTABLE_SHARE", 0.1)
    return now


def test_work_of_others_is_all_work_less_our_own(accounts):
    watch = Watch()
    # In 10 s: 25 + 5 s of work, of which we did 18 s; 2 s were taken away by the host.
    accounts |= {"passed": 10.0, "own": 18.0, "times": Times(25, 5, 6, 1, 2, 9)}
    assert watch.seen() == Neighbours(pytest.approx(1.4), 4, 10.0)
    assert str(watch.seen()) == "other programs kept 1.4 of 4 cores busy"
    assert "exclusive=false" in str(watch.seen()._replace(exclusive=False))


def test_alone_there_is_nothing_to_warn_of(accounts):
    watch = Watch()
    assert watch.seen().busy == 0.0
    accounts |= {"passed": 10.0, "own": 20.0, "times": Times(20, 3, 17, 0, 0, 0)}
    assert not watch.seen().notable
    accounts["times"] = Times(23, 3, 14, 0, 0, 0)
    assert watch.seen().notable
    # Nor of a time that is shorter than the accounts can tell.
    accounts |= {"passed": 0.05, "own": 0.0, "times": Times(0.2, 0, 0, 0, 0, 0)}
    assert watch.seen().busy == 4.0
    assert not watch.seen().notable


def test_the_work_of_a_child_is_our_own_while_it_runs_and_afterwards():
    lines = "import time\nwhile time.process_time() < 0.5: pass\nprint(flush=True)\ninput()"
    before = neighbours._of_children()
    command = [sys.executable, "-c", lines]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        child.stdout.readline()
        running = neighbours._of_children() - before
        child.stdin.close()
    ended = neighbours._of_children() - before
    assert 0.45 < running <= ended + 0.03 < 60  # the kernel counts in hundredths
