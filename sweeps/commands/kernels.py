"""`steerbench kernels`: error and throughput of every kernel; a wrong kernel is not timed."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bench.case import timed_rows
from bench.console import ConsoleLog
from bench.errors import SteerbenchError
from reports.tables import Table
from sweeps.device_lock import device_lock
from sweeps.terminal import show

COLUMNS = ("kernel", "case", "backend", "dtype", "error", "tolerance", "ms", "M items/s", "ratio")
"""`ratio`: time of the reference backend over time of this one, in the same case and run."""


def main(options: argparse.Namespace) -> int:
    """Print a table, then its rows as JSON in the last line; return 1 if any kernel is wrong."""
    import torch

    from methods.checks import found
    from methods.kernels import compiled

    if options.worth:
        from sweeps.worth import worth

        return worth(options.overrides, options.frames, options.repeats)
    log, device = ConsoleLog(Path()), "cuda" if torch.cuda.is_available() else "cpu"
    cases = [case for case in found("cases") if options.filter in case.subject]
    with device_lock("auto", log):
        rows = timed_rows(cases, device, compiled(device), options.repeats, log)
    if not rows:
        raise SteerbenchError(f"--filter: no kernel has {options.filter!r} in its name")
    show(Table("Kernels", COLUMNS, tuple(map(_line, rows))))
    print(json.dumps(rows))
    return int(any(row["status"] != "ok" for row in rows))


def _line(row: Mapping[str, Any]) -> tuple[str, ...]:
    labels = (row["kernel"], row["case"], row["backend"], row["dtype"])
    error = "not finite" if row["error"] is None else f"{row['error']:.1e}"
    errors = (error, "" if row["tolerance"] is None else f"{row['tolerance']:.1e}")
    if row["status"] != "ok":
        return (*labels, *errors, row["status"], "", "")
    ratio = f"{row['ratio']:.1f}x" if "ratio" in row else ""
    return (*labels, *errors, f"{row['ms']:.2f}", f"{row['mitems_s']:.2f}", ratio)
