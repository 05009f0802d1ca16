"""`steerbench scenes verify`: a copy of NeRF-Synthetic against the official checksums."""

from __future__ import annotations

import argparse
from pathlib import Path

from bench.console import ConsoleLog
from bench.scenes.integrity import verify

SHOWN = 5
"""Names printed of files that are missing or extra: there may be hundreds."""


def main(options: argparse.Namespace) -> int:
    """Print what differs; 1 if a file is not the official one, or none is there."""
    report = verify(options.path, ConsoleLog(Path("outputs")))
    for name in report.wrong:
        print(f"wrong    {name}")
    for kind, names in (("missing", report.missing), ("extra", report.extra)):
        for name in names[:SHOWN]:
            print(f"{kind:8} {name}")
        if len(names) > SHOWN:
            print(f"{kind:8} ... and {len(names) - SHOWN} more")
    print(f"{options.path}: {report}")
    return 0 if report.passed else 1
