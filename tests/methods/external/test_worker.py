"""Whatever a renderer's process does wrong is one line, and nothing is left of it."""

import os
import re
import select

import psutil
import pytest

from bench.clock import StageClock
from bench.errors import Unavailable
from bench.types import Budget, Log, Scene
from methods.external.method import External
from methods.external.worker import Worker
from tests.common import refusal

BUDGET = Budget("test", steps=7, samples=9)

TALK = """
    import os, socket, struct, subprocess, sys, threading
    import numpy as np
    from steerbench_worker import VARIABLE, VERSION, Channel

    channel = Channel(socket.socket(fileno=int(os.environ[VARIABLE])))
    raw = channel._connection
    subprocess.Popen(["sleep", "600"])
    print("its own words", flush=True)
    # hello
    channel.send("hello", version=VERSION, name="bad")
    while True:
        header, _ = channel.receive()
        size = header.get("height"), header.get("width"), 3
        if header["message"] == "render":
            # render
            channel.send("render", {"rgb": np.ones(size, "float32")}, ns=1000)
        elif header["message"] == "close":
            # close
            break
        else:
            channel.send(header["message"], sizes={})
"""
"""A worker that behaves, with comments where others do not."""

HANG = "threading.Event().wait()"
PICTURE = 'channel.send("render", {"rgb": np.full(size, %s)}, ns=%s)'
FAULTS = {
    "it dies": ("render", "os._exit(3)", r"ended with status 3, 'render' not answered"),
    "a system without memory kills it": ("render", "os.kill(os.getpid(), 9)", "was killed by SIG"),
    "it hangs": ("render", HANG, r"was silent for 0\.5 s, 'render' not answered"),
    "another version": ("hello", 'channel.send("hello", version=2)', "expected version 1"),
    "no hello": ("hello", HANG, r"was silent for 0\.5 s, 'hello' not answered"),
    "no hello, but an end": ("hello", "sys.exit()", "ended with status 0, 'hello' not answered"),
    "another size": (
        "render",
        'channel.send("render", {"rgb": np.ones((3, 2, 3))}, ns=1)',
        r"answered 'render' with rgb \[3, 2, 3\], expected rgb \[32, 40, 3\]",
    ),
    "no picture": ("render", 'channel.send("render", ns=1)', "rgb none, expected"),
    "negative time": ("render", PICTURE % ("0.5", -1), "a wrong ns: .* got -1"),
    "the time since 1970": (
        "render",
        PICTURE % ("0.5", 10**18),
        "a wrong ns: expected at most the .* ns by the clock here",
    ),
    "no stages": (
        "render",
        'channel.send("render", {"rgb": np.ones(size)}, ns=1, stages=[1])',
        "expected stages and counters by name",
    ),
    "a counter that falls": (
        "render",
        'channel.send("render", {"rgb": np.ones(size)}, ns=1, counters={"rays": -1})',
        "a wrong rays: .* got -1",
    ),
    "more in its stages than in the frame": (
        "render",
        'channel.send("render", {"rgb": np.ones(size)}, ns=1, stages={"march": 2})',
        "a wrong ns of the stages: expected at most 1 in all",
    ),
    "half a picture": (
        "render",
        'header = b\'{"message": "render", "arrays": [["rgb", "uint8", [32, 40, 3]]]}\'\n'
        'raw.sendall(struct.pack("<I", len(header)) + header + bytes(1000)); os._exit(0)',
        "ended with status 0, 'render' not answered",
    ),
    "a header that is no JSON": (
        "render",
        'raw.sendall(struct.pack("<I", 4) + b"{,,}")',
        "answered 'render' with a header that is no JSON",
    ),
    "no message at all": ("render", 'raw.sendall(b"Traceback")', "a header of 1667330644 bytes"),
    "another answer": ("render", 'channel.send("sizes")', "expected the same message"),
}


def talking(place: str, lines: str) -> str:
    """The worker `TALK`, with `lines` at one of its places."""
    (indent,) = re.findall(rf"^( *)# {place}$", TALK, re.MULTILINE)
    return TALK.replace(f"# {place}", lines.replace("\n", f"\n{indent}"))


def render(method: External, scene: Scene, log: Log) -> None:
    method.fit(scene, BUDGET, log)
    clock = StageClock("cpu")
    with clock.frame():
        method.render(scene.splits["test"].cameras[0], clock)


@pytest.fixture
def started(monkeypatch) -> list[psutil.Process]:
    """The processes of all workers, and those that these have started."""
    processes = []
    end = Worker._end

    def noted(worker):
        if not worker._output.closed and worker._process.poll() is None:
            this = psutil.Process(worker._process.pid)
            processes.extend((this, *this.children(recursive=True)))
        end(worker)

    monkeypatch.setattr(Worker, "_end", noted)
    return processes


def gone(process: psutil.Process) -> bool:
    """Whether a process that was killed has ended, also if nobody has asked how; waits for it."""
    try:
        ended = os.pidfd_open(process.pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([ended], [], [], 10)[0])
    finally:
        os.close(ended)


@pytest.mark.parametrize(("place", "lines", "said"), FAULTS.values(), ids=FAULTS)
def test_what_it_does_wrong_is_one_line_with_its_last_words(
    place, lines, said, worker, external, tiny_scene, quiet_log, started
):
    limit_s = 0.5 if lines == HANG else 60.0
    method = external(worker(before=talking(place, lines), after=""), frame_s=limit_s)
    method.start_s = limit_s if place == "hello" else 60.0
    with refusal(said) as error:
        render(method, tiny_scene, quiet_log)
    message = str(error.value)
    assert message.startswith(f"worker {'bad' if place == 'render' else ''}")
    if (place, lines) != ("hello", HANG):  # it may not have come to say them
        assert message.endswith("; its last words: its own words")
    assert "\n" not in message
    assert all(map(gone, started))


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("pass", []),
        (
            'channel.send("render", {"rgb": np.ones((32, 40, 3))}, ns=1)',
            ["steerbench: worker bad: still said 'render' after 'close'"],
        ),
    ],
)
def test_it_ends_with_everything_it_started_and_what_it_says_after_close_is_one_line(
    lines, said, worker, external, tiny_scene, quiet_log, started, capfd
):
    method = external(worker(before=talking("close", lines), after=""))
    render(method, tiny_scene, quiet_log)
    del method
    told = capfd.readouterr().err.splitlines()
    assert [line.partition("; its last words: its own")[0] for line in told] == said
    assert len(started) == 2
    assert all(map(gone, started))


@pytest.mark.parametrize(
    ("raised", "said"),
    [
        ('ValueError("no such thing\\nat all")', "ValueError: no such thing at all; its last"),
        ("MemoryError()", "MemoryError: ; its last words"),
    ],
)
def test_an_exception_is_told_and_its_traceback_is_among_the_last_words(
    raised, said, worker, external, tiny_scene, quiet_log
):
    lines = f"""
    def render(self, camera):
        raise {raised}
    Grey.render = render
    """
    with refusal(f"worker Grey: failed at 'render': {said}") as error:
        render(external(worker(lines)), tiny_scene, quiet_log)
    assert "Error" in str(error.value).rpartition("last words")[2]


@pytest.mark.parametrize("command", ["", "worker.py 'a"])
def test_what_is_no_command_is_refused(external, command):
    with refusal(r"method\.command: expected a program and its arg"):
        external(command).settings()


def test_what_is_no_program_is_an_error_about_the_command(external):
    with refusal(r"method\.command: cannot start 'no-such-program'", Unavailable):
        _ = external("no-such-program --fast").name


def test_what_it_prints_disturbs_nothing_and_is_kept(
    worker, external, tiny_scene, quiet_log, tmp_path
):
    lines = """
    import os
    print("to standard output")
    os.system("echo from a program of its own")
    """
    render(external(worker(lines)), tiny_scene, quiet_log)
    (kept,) = tmp_path.glob("outputs/stages/*/output.txt")
    assert kept.read_text() == "to standard output\nfrom a program of its own\n"
