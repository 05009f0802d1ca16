"""The log for a user at a terminal: messages, progress with the time left, stage folders."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

from rich import progress
from rich.console import Console

from bench.errors import explained
from bench.kinds import Say
from bench.results import content_key

PLAIN_INTERVAL_S = 10.0  # between two progress lines without a terminal to draw a bar on
DRAW_INTERVAL_S = 0.2  # between two redraws of a bar
WORTH_A_LINE_S = 2.0  # work that takes longer leaves a line on the screen when it is done


class ConsoleLog:
    """A `bench.types.Log` on standard error: standard output holds only results."""

    def __init__(
        self, root: Path, quiet: bool = False, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.followers: list[Say] = []  # each gets every line of progress
        self._root = root
        self._console = Console(stderr=True, quiet=quiet)
        self._clock = clock
        self._bars = progress.Progress(
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.TaskProgressColumn(),
            progress.TimeElapsedColumn(),
            progress.TimeRemainingColumn(),
            progress.TextColumn("{task.fields[note]}", markup=False),
            console=self._console,
            transient=True,
            auto_refresh=False,  # it would use a thread, which disturbs what is being measured
            get_time=clock,
            disable=quiet or not self._console.is_terminal,
        )

    def info(self, message: str) -> None:
        self._console.print(message, markup=False, highlight=False, soft_wrap=True)

    @contextmanager
    def progress(self, label: str, total: int) -> Iterator[_Bar]:
        """Show a bar, or a line now and then without a terminal; bars may nest."""
        bar = _Bar(self, self._bars, label, total)
        self._bars.start()
        try:
            yield bar
            if bar.elapsed > WORTH_A_LINE_S:
                self.info(bar.line(f"done in {_duration(bar.elapsed)}"))
        finally:
            self._bars.remove_task(bar.id)
            self._bars.refresh()
            if not self._bars.tasks:
                self._bars.stop()

    def stage_dir(self, kind: str, key: Mapping[str, object]) -> Path:
        """`stages/<kind>-<hash of key>`, created if missing; SteerbenchError if it cannot be."""
        folder = self._root / "stages" / f"{kind}-{content_key(key)[:12]}"
        with explained(folder):
            folder.mkdir(parents=True, exist_ok=True)
        return folder


class _Bar:
    def __init__(self, log: ConsoleLog, bars: progress.Progress, label: str, total: int) -> None:
        self._log, self._bars = log, bars
        self.id = bars.add_task(label, total=total, note="")
        self._task = bars.tasks[-1]
        self._shown = 0.0

    def advance(self, steps: int = 1, note: str = "") -> None:
        self._bars.update(self.id, advance=steps, note=note)
        plain, elapsed = self._bars.disable, self.elapsed
        if elapsed - self._shown < (PLAIN_INTERVAL_S if plain else DRAW_INTERVAL_S):
            return
        self._shown, task = elapsed, self._task
        left = "?" if task.time_remaining is None else _duration(task.time_remaining)
        line = self.line(f"{task.percentage:.0f} %, {_duration(elapsed)} elapsed, {left} left")
        for tell in self._log.followers:
            tell(line)
        if plain:
            self._log.info(line)
        else:
            self._bars.refresh()

    @property
    def elapsed(self) -> float:
        return self._task.elapsed or 0.0

    def line(self, text: str) -> str:
        note = self._task.fields["note"]
        return f"{self._task.description}: {text}" + (f", {note}" if note else "")


def _duration(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
