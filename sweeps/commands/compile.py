"""`steerbench compile`: compile kernels for this CPU now, not when they are first called.

A kernel is compiled by computing its cases, which covers all types of inputs.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path

from bench.console import ConsoleLog
from methods import checks
from methods.kernels.compilation import wrong_of
from sweeps.overrides import composed, target_of
from sweeps.processes import processes
from sweeps.terminal import note


def main(options: argparse.Namespace) -> int:
    """Compile kernels for this CPU, on all cores; return 1 if one of them is wrong."""
    names = needed(options.methods) if options.methods else checks.modules("cases")
    with (
        processes(len(os.sched_getaffinity(0))) as pool,
        ConsoleLog(Path()).progress("compiling kernels", len(names)) as bar,
    ):
        wrong = []
        for ended in as_completed([pool.submit(wrong_of, name) for name in names]):
            wrong += ended.result()
            bar.advance()
    for case in sorted(wrong):
        note(f"wrong on this machine: {case}; see `steerbench kernels`")
    return int(bool(wrong))


def needed(methods: Sequence[str]) -> list[str]:
    """The modules of cases beside what the classes of `methods` import."""
    for method in methods:
        target_of(composed([f"method={method}"]).method)
    return [name for name in checks.modules("cases") if name.rpartition(".")[0] in sys.modules]
