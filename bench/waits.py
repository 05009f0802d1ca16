"""Where the host waits for a GPU: counts the waits by the line that causes them."""

import linecache
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import dropwhile
from pathlib import Path
from typing import NamedTuple

import torch

from bench.errors import Unavailable

TORCH = str(Path(torch.__file__).parent)
ROOT = f"{Path(__file__).parent.parent}/"


class CodeLine(NamedTuple):
    path: str
    number: int

    @property
    def place(self) -> str:
        """File and line number; the path is relative to the repository if the file is inside it."""
        return f"{self.path.removeprefix(ROOT)}:{self.number}"

    @property
    def source(self) -> str:
        return linecache.getline(*self).strip()


@contextmanager
def device_waits() -> Iterator[Counter[CodeLine]]:
    """Count how often the host waits for the GPU inside the context, by the line that caused it.

    Torch reports the waits (`torch.cuda.set_sync_debug_mode`), except explicit synchronisation as
    by a clock. Raises Unavailable if there is no GPU.
    """
    if not torch.cuda.is_available():
        raise Unavailable("to count how often the host waits for the device, a GPU is needed")
    waits: Counter[CodeLine] = Counter()

    def note(message, category, filename, lineno, file=None, line=None):
        if "synchronizing CUDA operation" in str(message):
            # The innermost line outside torch, from the line outwards that the warning names.
            warned = CodeLine(filename, lineno)
            lines = (CodeLine(f.f_code.co_filename, n) for f, n in traceback.walk_stack(None))
            outwards = dropwhile(lambda line: line != warned, lines)
            waits[next((x for x in outwards if not x.path.startswith(TORCH)), warned)] += 1
        else:
            show(message, category, filename, lineno, file, line)

    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        warnings.filterwarnings("always", "called a synchronizing CUDA operation")
        show, warnings.showwarning = warnings.showwarning, note
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield waits
        finally:
            torch.cuda.set_sync_debug_mode(before)
