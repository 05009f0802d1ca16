"""Numerical stress: what must hold where numbers are extreme, and the worst that was seen.

The cases stand beside what they test. A tolerance is derived from the arithmetic, never from what
was seen, and says where it comes from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch

from bench.types import Log, Unavailable

Cell = tuple[str, str]
"""Who computes, a backend or an engine, and at which precision."""


@dataclass(frozen=True)
class StressCase:
    """Something that must hold, whoever computes it.

    Attributes:
        subject: what is tested ("composite").
        name: what is extreme about it.
        holds: what must hold.
        derivation: where the tolerances come from.
        tolerances: the largest error that is right, of each cell of the table.
        worst: backend, device and precision to the largest error seen. It raises `Unavailable`
            where the cell cannot be had on that device.
        slow: takes more than a moment: for the command, not for the tests.
    """

    subject: str
    name: str
    holds: str
    derivation: str
    tolerances: Mapping[Cell, float]
    worst: Callable[[str, str, str], float]
    slow: bool = False

    def check(self, cell: Cell, device: str) -> dict[str, Any]:
        """The row of one cell.

        It holds subject, case, holds, derivation, device, backend, precision, tolerance, error
        (None where it is not finite or there is none) and status: "ok", "failed", "failed: " with
        what was raised, or "unavailable: " with the reason.
        """
        backend, precision = cell
        error, tolerance = math.inf, self.tolerances[cell]
        try:
            error = self.worst(backend, device, precision)
            status = "ok" if error <= tolerance else "failed"
        except Unavailable as reason:
            status = f"unavailable: {reason}"
        except (MemoryError, torch.OutOfMemoryError):
            status = "unavailable: more memory is needed than there is"
        except Exception as raised:  # a crash is what the case was looking for
            status = f"failed: {type(raised).__name__}: {raised}"
        return {
            "subject": self.subject,
            "case": self.name,
            "holds": self.holds,
            "derivation": self.derivation,
            "device": device,
            "backend": backend,
            "precision": precision,
            "tolerance": tolerance,
            "error": error if math.isfinite(error) else None,
            "status": status,
        }


def run_cases(
    cases: Sequence[StressCase], devices: Sequence[str], log: Log
) -> Iterator[dict[str, Any]]:
    """The rows of all cells of `cases` on all `devices`, one case after the other; see
    `StressCase.check`."""
    cells = sum(len(case.tolerances) for case in cases)
    with log.progress("stress", cells * len(devices)) as progress:
        for case, device in product(cases, devices):
            for cell in case.tolerances:
                progress.advance(0, note=f"{case.subject}, {case.name}: {' '.join(cell)}")
                yield case.check(cell, device)
                progress.advance(note="")


def failed(row: Mapping[str, Any]) -> bool:
    """Whether what must hold does not."""
    return row["status"].startswith("failed")
