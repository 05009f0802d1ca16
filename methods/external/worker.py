"""A renderer's process, and the conversation with it, whatever the process does."""

import os
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import torch

from bench.errors import SteerbenchError, Unavailable
from bench.kinds import Words
from steerbench_worker import VARIABLE, VERSION, Channel

Header = dict[str, Any]

END_S = 10.0  # a process that has been told to close is killed after so many seconds


class Worker:
    """A process that was started with `command` and speaks the protocol of docs/external.md; its
    environment has `variables`, too.

    Whatever it does wrong is one SteerbenchError with its name and its last words. It is killed
    then, and so are the processes that it has started."""

    def __init__(self, command: Words, limit_s: float, variables: Mapping[str, str]) -> None:
        self.name = command[-1]  # until it tells one
        self._output = tempfile.TemporaryFile()  # noqa: SIM115  it is closed by `_end`
        here, there = socket.socketpair()
        self._channel, self._socket = Channel(here), here
        environment = {
            **os.environ,
            VARIABLE: str(there.fileno()),
            "OMP_NUM_THREADS": str(torch.get_num_threads()),
            "PYTHONUNBUFFERED": "1",  # or its last words are lost
            **variables,
        }
        try:
            with there:
                self._process = subprocess.Popen(
                    command,
                    env=environment,
                    pass_fds=[there.fileno()],
                    stdin=subprocess.DEVNULL,
                    stdout=self._output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # with a group of its own, which can be killed
                )
        except OSError as error:
            here.close()
            self._output.close()
            why = f"cannot start {command[0]!r}: {error.strerror}"
            raise Unavailable(f"method.command: {why}; expected a program") from error
        hello, _ = self.ask("hello", limit_s)
        self.expect(hello.get("version") == VERSION, "hello", f"version {VERSION}", hello)
        self.expect(isinstance(hello.get("name"), str), "hello", "a name", hello)
        self.name = hello["name"]

    def ask(
        self,
        message: str,
        limit_s: float,
        fields: Mapping[str, object] | None = None,
        progress: Callable[[Header], object] | None = None,
    ) -> tuple[Header, dict[str, np.ndarray]]:
        """Send a message, unless `fields` are None; the header and the arrays of its answer. Before
        an answer, and before each message to `progress`, it may be silent for `limit_s`."""
        try:
            self._channel.until = time.monotonic() + limit_s
            if fields is not None:
                self._channel.send(message, **fields)
            header, arrays = self._channel.receive()
            while progress and header["message"] == "progress":
                progress(header)
                self._channel.until = time.monotonic() + limit_s
                header, arrays = self._channel.receive()
        except TimeoutError as error:
            raise self.fault(f"was silent for {limit_s:g} s, {message!r} not answered") from error
        except (EOFError, ConnectionError) as error:
            raise self.fault(f"{self._ending()}, {message!r} not answered") from error
        except (ValueError, MemoryError) as error:
            raise self.fault(f"answered {message!r} with {error}") from error
        except BaseException:
            self._end()
            raise
        if header["message"] == "error":
            fault = self.fault(f"failed at {message!r}: {header.get('text')}")
            kind, _, said = str(header.get("text")).partition(": ")
            raise SteerbenchError(f"{self.name}: {said}") if kind == "SteerbenchError" else fault
        self.expect(header["message"] == message, message, "the same message", header)
        return header, arrays

    @property
    def answered_ns(self) -> int:
        """When the last answer began to arrive, by `time.perf_counter_ns`."""
        return self._channel.began_ns

    def expect(self, holds: bool, message: str, expected: str, got: object) -> None:
        """Raise the SteerbenchError about an answer to `message` unless something `holds`."""
        if not holds:
            raise self.fault(f"answered {message!r} with {got!s:.100}, expected {expected}")

    def fault(self, why: str) -> SteerbenchError:
        """Kill the process, and return the error that says `why`."""
        words = [line.strip()[:160] for line in self.output().splitlines()[-200:] if line.strip()]
        last = f"its last words: {' | '.join(words[-3:])}" if words else "it has printed nothing"
        self._end()
        return SteerbenchError(" ".join(f"worker {self.name}: {why}; {last}".split()))

    def output(self) -> str:
        """What it has printed so far."""
        file = self._output.fileno()
        # Not by seeking: the process writes where this file is read.
        return os.pread(file, os.fstat(file).st_size, 0).decode(errors="replace")

    def close(self) -> None:
        """Let it end, or kill it; SteerbenchError if it still says anything."""
        if self._output.closed:
            return
        self._channel.until = time.monotonic() + END_S
        try:
            with suppress(EOFError, OSError):
                self._channel.send("close")
                header, _ = self._channel.receive()
                raise ValueError(header["message"])
        except ValueError as error:
            raise self.fault(f"still said {str(error)[:100]!r} after 'close'") from error
        finally:
            self._end()

    def _ending(self) -> str:
        """How it has ended, once the connection is closed."""
        try:
            status = self._process.wait(1.0)
        except subprocess.TimeoutExpired:
            return "closed the connection"
        if status == -signal.SIGKILL:
            return "was killed by SIGKILL, as by a system without memory"
        if status < 0:
            return f"was killed by {signal.Signals(-status).name}"
        return f"ended with status {status}"

    def _end(self) -> None:
        """Kill the process and all that it has started, if that has not been done."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._socket.close()
        self._output.close()
