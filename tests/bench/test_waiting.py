"""The queue of a device: trainings share its cores, timings have it alone, nobody overtakes."""

import subprocess
import sys

import pytest

from bench.waiting import Holder

WAITER = """
import sys
from pathlib import Path
from bench import waiting

class Log:
    followers = []
    def info(self, message):
        print(message, flush=True)

waiting.WRITE_S, log = -1, Log()
with waiting.queued(Path(sys.argv[1]), None if sys.argv[2] == "alone" else 1, "cpu", log):
    log.info("its turn")
    for line in sys.stdin:
        log.followers[0](line.strip())
        log.info("told")
"""


@pytest.mark.parametrize(
    ("came", "begin"),
    [
        ([1, 1, 1], [0, 1]),
        ([2, 1], [0]),
        ([1, 2, 1], [0]),  # the last has a core, but would overtake
        ([1, None], [0]),
        ([1, None, 1], [0]),
        ([None, 1, None], [0]),
    ],
)
def test_trainings_share_the_cores_a_timing_is_alone_and_the_first_comes_first(came, begin):
    holders = [Holder(threads, (0, 1)) for threads in came]
    assert [n for n, each in enumerate(holders) if not each.blocking(holders[:n])] == begin


def test_trainings_wait_only_for_those_on_their_cores_and_a_timing_for_all():
    there = [Holder(2, (0, 1))]
    assert not Holder(2, (2, 3)).blocking(there)
    assert Holder(2, (1, 2)).blocking(there) == Holder(None, (2, 3)).blocking(there) == there


def test_who_waits_is_told_for_whom_how_far_that_is_and_the_next_when_it_was_killed(tmp_path):
    def start(how):
        words = [sys.executable, "-c", WAITER, str(tmp_path / "device.lock"), how]
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        return subprocess.Popen(words, **pipes)

    with start("training") as first:
        assert first.stdout.readline() == "its turn\n"
        print("training: 45 %", file=first.stdin, flush=True)
        assert first.stdout.readline() == "told\n"
        with start("alone") as second:
            line = second.stdout.readline()
            assert f"waiting for cpu: process {first.pid} (-c {tmp_path}" in line
            assert line.endswith("training: 45 %\n")
            with start("training") as third:
                assert f"process {first.pid} " in third.stdout.readline()
                first.kill()
                assert second.stdout.readline() == "its turn\n"
                assert f"process {second.pid} " in third.stdout.readline()
                second.communicate("")
                assert third.stdout.readline() == "its turn\n"
                third.communicate("")
    with start("alone") as last:
        assert last.stdout.readline() == "its turn\n"
        assert len(list(tmp_path.glob("*.json"))) == 1  # what the killed one left is gone
        last.communicate("")
