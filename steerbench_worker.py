"""Make a renderer a worker of steerbench. Copy this file beside your code: Python 3.8, numpy.

    from steerbench_worker import serve

    class Mine:
        def fit(self, job):        # train on the pictures of job
            ...
        def render(self, camera):  # return a picture [height, width, 3]
            ...

    if __name__ == "__main__":
        serve(Mine)

What else the class may have, as `serve` explains, is optional. The messages that go over the socket
are in docs/external.md of steerbench.
"""

import json
import math
import os
import re
import select
import socket
import struct
import sys
import sysconfig
import threading
import time
import traceback
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

VERSION = 1  # of the protocol
VARIABLE = "STEERBENCH_SOCKET"  # the environment variable with the socket's file descriptor
DTYPES = ("uint8", "float16", "float32", "float64")
LENGTH = struct.Struct("<I")
MOST_HEADER, MOST_ARRAY = 1 << 26, 1 << 32  # bytes; more is no message, but something else


class SteerbenchError(Exception):
    """An error whose message says all: the user sees nothing else."""


class Channel:
    """Messages over a connected socket: a JSON header with its length before it, then arrays.

    `until` is the moment, as of `time.monotonic`, after which both methods raise TimeoutError.
    """

    def __init__(self, connection):
        self._connection = connection
        self.until = None
        self.began_ns = 0  # when the last message that was received began to arrive

    def send(self, message, arrays=None, **fields):
        """Send a `message` with its `fields`, and `arrays` by name."""
        plain = {name: _little(array) for name, array in (arrays or {}).items()}
        listed = [[name, array.dtype.name, array.shape] for name, array in plain.items()]
        header = json.dumps({"message": message, **fields, "arrays": listed}).encode()
        self._arm()
        self._connection.sendall(LENGTH.pack(len(header)) + header)
        for array in plain.values():
            self._connection.sendall(array.reshape(-1).view(np.uint8))

    def receive(self):
        """The header of the next message, a dict, and its arrays by name.

        Raises EOFError if the other side has closed the connection, ValueError if what comes is
        no message.
        """
        (length,) = LENGTH.unpack(self._read(LENGTH.size, "between two messages"))
        self.began_ns = time.perf_counter_ns()
        if length > MOST_HEADER:
            raise ValueError(f"a header of {length} bytes")
        text = self._read(length).tobytes()
        try:
            header = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"a header that is no JSON ({error}): {text[:40]}") from error
        if not isinstance(header, dict) or not isinstance(header.get("message"), str):
            raise ValueError(f"a header without a message: {text[:40]}")
        arrays = header.pop("arrays", [])
        return header, dict(map(self._array, arrays if isinstance(arrays, list) else [arrays]))

    def _array(self, described):
        try:
            name, dtype, shape = described
            size = math.prod(shape) * np.dtype(dtype).itemsize
            known = dtype in DTYPES and all(type(side) is int and side >= 0 for side in shape)
        except (TypeError, ValueError):
            known = False
        if not known or size > MOST_ARRAY:
            raise ValueError(f"an array that the protocol does not have: {described}")
        return name, self._read(size).view(np.dtype(dtype).newbyteorder("<")).reshape(shape)

    def _read(self, size, where="in the middle of a message"):
        buffer = np.empty(size, np.uint8)
        left = buffer.data
        self._arm()
        while left:
            got = self._connection.recv_into(left)
            if not got:
                raise EOFError("closed the connection " + where)
            left, where = left[got:], "in the middle of a message"
        return buffer

    def _arm(self):
        left = None if self.until is None else max(self.until - time.monotonic(), 1e-3)
        self._connection.settimeout(left)


def _little(array):
    array = np.ascontiguousarray(array)
    if array.dtype.name not in DTYPES:
        raise ValueError(f"an array of {array.dtype}, expected one of {', '.join(DTYPES)}")
    return array.astype(array.dtype.newbyteorder("<"), copy=False)


class Camera:
    """A pinhole: `width`, `height`, `fx`, `fy`, `cx`, `cy` in pixels, and `c2w`, camera-to-world
    [3, 4] with OpenCV axes (x right, y down, z forward) in the units of the data set. Pixel (i, j)
    spans [i, i + 1) x [j, j + 1)."""

    def __init__(self, described):
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            setattr(self, name, described[name])
        self.c2w = np.array(described["c2w"], dtype=np.float64)


class Job:
    """What a renderer is to learn."""

    scene: Path  # the folder with the pictures, in NeRF-Synthetic's layout; gone after `fit`
    pictures: list  # of (file, Camera), the same as in the folder: training pictures alone
    state: Path  # the folder for the trained model; another after `fit`; None without `fit`
    background: list  # [3] in [0, 1], onto which pictures with an alpha are composited
    bounds: list  # lower and upper corner of the content, in the units of the data set
    steps: int  # of the optimiser; the other two: samples a step, steps of a second stage
    samples: int
    renderer_steps: int
    seed: int  # of everything random

    def __init__(self, header, channel):
        self.__dict__.update(header)
        self._channel, self._told = channel, 0.0
        for name in ("scene", "state"):
            setattr(self, name, header.get(name) and Path(header[name]))
        pictures = header.get("pictures", ())
        self.pictures = [(self.scene / each["file"], Camera(each)) for each in pictures]

    def progress(self, done, total, note=""):
        """Show how far the training is; also resets the time limit for it."""
        if time.monotonic() - self._told > 0.2 or done == total:
            self._told = time.monotonic()
            self._channel.send("progress", done=int(done), total=int(total), note=str(note))


class _Clock:
    """Charges every nanosecond of a frame to its innermost open stage, as steerbench does."""

    def __init__(self):
        self.stages, self.counters, self.open = {}, {}, []
        self.first = self.last = _now()

    def charge(self):
        now, name = _now(), "/".join(self.open)
        self.stages[name] = self.stages.get(name, 0) + now - self.last
        self.last = now

    def report(self):
        self.charge()
        stages = {name: ns for name, ns in self.stages.items() if name}
        return {"ns": self.last - self.first, "stages": stages, "counters": self.counters}


@contextmanager
def stage(name):
    """Time a part of `render`; stages may be nested, and entered many times a frame."""
    frame = _frames[-1]
    frame.charge()
    frame.open.append(name)
    try:
        yield
    finally:
        frame.charge()
        frame.open.pop()


def count(name, done):
    """Add `done` units of work to a counter of this frame."""
    counters = _frames[-1].counters
    counters[name] = counters.get(name, 0) + int(done)


def serve(kind):
    """Make a renderer `kind(**settings)`, and do what steerbench asks until it closes.

    render(camera): a picture [height, width, 3], 8 bit or in [0, 1], of numpy or torch; or a dict
        with the picture `rgb` and, optionally, `depth` (along z) and `alpha`, [height, width]
    fit(job): train, see `Job`. Without it nothing is trained.
    load(job): load from `job.state` what `fit` stored there. Without it every run trains again.
    reset(): a new sequence of frames begins
    sizes(): bytes of the model by component; without it, those of the files in `job.state`
    peak_bytes(): its peak memory, None: unknown; without it, that of this process or its GPU
    name, device, precision, memory: attributes for rows; `memory`: preceding frames that are used
    knobs: a dict of settings that need no new training, each with a list of values to try
    files: those that the pictures depend on, beside the modules that are loaded once it is made
    late: whether modules that are loaded afterwards need no key, because versions of packages stand
        for them; otherwise they are refused
    notes: lines to show to the user once it has loaded
    """
    if VARIABLE not in os.environ:
        sys.exit("This is a worker: run it by `steerbench run method=external method.command=...`.")
    connection = socket.socket(fileno=int(os.environ.pop(VARIABLE)))
    connection.set_inheritable(False)  # a process that this one starts must not keep it open
    _end_with(connection)
    channel = Channel(connection)
    channel.send("hello", version=VERSION, name=getattr(kind, "name", kind.__name__))
    try:
        _converse(channel, kind)
    except Exception as error:
        traceback.print_exc()
        with suppress(OSError):
            channel.send("error", text=f"{type(error).__name__}: {error}")


def _converse(channel, kind):
    renderer, stored = kind, {}
    while True:
        header, _ = channel.receive()
        message, answer = header["message"], {}
        arrays: dict = {}
        if message == "close":
            return
        if message == "settings":
            renderer = kind(**header["options"])
            answer = _about(renderer)
            _forget_peak()
        elif message in ("fit", "load"):
            job = Job(header, channel)
            getattr(renderer, message)(job)
            files = [path for path in job.state.rglob("*") if path.is_file()] if job.state else []
            answer = {"notes": list(getattr(renderer, "notes", ()))}
            stored = {"model": sum(path.stat().st_size for path in files)} if files else {}
            _forget_peak()
        elif message == "reset":
            getattr(renderer, "reset", lambda: None)()
        elif message == "render":
            camera = Camera(header)
            _frames[-1] = _Clock()
            picture = renderer.render(camera)
            arrays = picture if isinstance(picture, dict) else {"rgb": picture}
            # `_now` waits only for torch: what else computes in the background is fetched before.
            arrays = {k: x if hasattr(x, "detach") else np.asarray(x) for k, x in arrays.items()}
            peak_bytes = getattr(renderer, "peak_bytes", _peak)()
            answer = {**_frames[-1].report(), "peak_bytes": peak_bytes}
            of_torch = {k: x.detach().cpu() for k, x in arrays.items() if hasattr(x, "detach")}
            arrays.update({k: x.numpy() for k, x in of_torch.items()})
        elif message == "sizes":
            sizes = renderer.sizes() if hasattr(renderer, "sizes") else stored
            answer = {"sizes": sizes}
            if not getattr(renderer, "late", False):
                answer["files"] = _files()
        else:
            raise ValueError(f"steerbench asked for {message!r}, which this worker does not know")
        channel.send(message, arrays, **answer)


def _about(renderer):
    """What rows and keys say about a renderer."""
    torch = sys.modules.get("torch")
    device = "cuda" if torch and torch.cuda.is_available() else "cpu"
    usual: dict = {"name": type(renderer).__name__, "device": device, "precision": "unknown"}
    usual.update(memory=0, knobs={})
    told = {name: getattr(renderer, name, value) for name, value in usual.items()}
    can = [message for message in ("fit", "load") if hasattr(renderer, message)]
    files = [*_files(), *map(str, getattr(renderer, "files", ()))]
    return {**told, "can": can, "files": files, "packages": _packages()}


def _files():
    """The files of all loaded modules that belong neither to Python nor to an installed package."""
    library = {Path(sysconfig.get_paths()[name]) for name in ("stdlib", "platstdlib")}
    files = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    paths = {Path(file).absolute() for file in files if file}
    installed = {"site-packages", "dist-packages"}
    return sorted(
        str(path)
        for path in paths
        if path.is_file() and not library & set(path.parents) and not installed & set(path.parts)
    )


def _packages():
    """The version of every package of this environment, and of Python."""
    from importlib import metadata  # takes 0.1 s, while steerbench waits

    found = {each.metadata["Name"]: each.version for each in metadata.distributions()}
    return {"python": sys.version.split()[0], **{str(k): str(v) for k, v in found.items()}}


def _now():
    """The time in nanoseconds, once a GPU has finished its work."""
    cuda, gpus = _cuda()
    for gpu in gpus:
        cuda.synchronize(gpu)
    return time.perf_counter_ns()


def _cuda():
    """`torch.cuda`, and the GPUs that this process uses."""
    torch = sys.modules.get("torch")
    cuda = torch.cuda if torch and torch.cuda.is_initialized() else None
    if not cuda:
        return None, []
    return cuda, [gpu for gpu in range(cuda.device_count()) if cuda.memory_reserved(gpu)]


def _forget_peak():
    cuda, gpus = _cuda()
    for gpu in gpus:
        cuda.reset_peak_memory_stats(gpu)
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak():
    """Peak memory in bytes since `_forget_peak`: of the GPUs, or of this process; None: unknown."""
    (cuda, gpus), found = _cuda(), None
    if gpus:
        return sum(map(cuda.max_memory_allocated, gpus))
    with suppress(OSError):
        found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    return found and 1024 * int(found.group(1))


_frames = [_Clock()]  # the clock of the present frame


def _end_with(connection):
    """End this process at once when the other side is gone, whatever it is doing."""
    poll = select.poll()
    poll.register(connection, getattr(select, "POLLRDHUP", 0) | select.POLLHUP)

    def wait():
        poll.poll()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
