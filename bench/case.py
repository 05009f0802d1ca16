"""A case: one check, what must hold and within which tolerance.

Each folder keeps its cases in `cases.py`. A tolerance is derived from the arithmetic, in units of
the unit roundoff u of the type that the result is computed in, never from an observed error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from bench.types import Unavailable

Cell = tuple[str, str]
"""A backend or an engine, and a precision."""

Prepare = Callable[[str], Callable[[str], tuple[Tensor, ...]]]
"""Makes inputs on a device and returns a function of the backend that computes the outputs."""

DTYPES = {
    "fp64": torch.float64,
    "fp32": torch.float32,
    "fp16": torch.float16,
    "bf16": torch.bfloat16,
}

U32 = 2.0**-24
"""Unit roundoff of float32."""

U16 = 2.0**-8
"""Unit roundoff of bfloat16, and its ulp from 1/2 to 1: two nearly equal numbers below 1 may round
to neighbours."""


@dataclass(frozen=True)
class Timed:
    """A computation to time; one call processes `items` samples, rays or entries."""

    items: int
    prepare: Prepare


@dataclass(frozen=True)
class Case:
    """A property that must hold for every backend or engine.

    Attributes:
        subject: the computation that is checked ("composite backward").
        name: what is special about the inputs.
        holds: what must hold.
        derivation: where the tolerances come from.
        tolerances: the largest allowed error of each cell.
        error: computes the largest error, given backend, device and precision. Raises `Unavailable`
            if the cell does not exist on that device.
        timed: None if there are too few inputs for a meaningful throughput.
        slow: takes more than a moment, so the tests skip it.
    """

    subject: str
    name: str
    holds: str
    derivation: str
    tolerances: Mapping[Cell, float]
    error: Callable[[str, str, str], float]
    timed: Timed | None = None
    slow: bool = False

    @property
    def quick(self) -> bool:
        """Whether its inputs are few, so that checking it takes but a moment."""
        return not (self.slow or self.timed)

    def check(self, cell: Cell, device: str) -> dict[str, Any]:
        """Check one cell and return its row.

        The row holds subject, case, holds, derivation, device, backend, precision, tolerance, error
        (None if missing or not finite) and status: "ok", "failed", "failed: " with the exception,
        or "unavailable: " with the reason.
        """
        backend, precision = cell
        error, tolerance = math.inf, self.tolerances[cell]
        try:
            error = self.error(backend, device, precision)
            status = "ok" if error <= tolerance else "failed"
        except Unavailable as reason:
            status = f"unavailable: {reason}"
        except (MemoryError, torch.OutOfMemoryError):
            status = "unavailable: more memory is needed than there is"
        except Exception as raised:  # a crash fails the case
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


@dataclass(frozen=True)
class Property:
    """A property that several cases check, with the same tolerances; see `Case`."""

    subject: str
    holds: str
    derivation: str
    tolerances: Mapping[Cell, float]

    def case(self, name: str, error: Callable[[str, str, str], float], slow: bool = False) -> Case:
        """Make one case of the property."""
        given = self.subject, name, self.holds, self.derivation, self.tolerances, error
        return Case(*given, slow=slow)


@dataclass(frozen=True)
class Difference:
    """Computes the largest difference from the reference backend on the CPU."""

    prepare: Prepare

    def __call__(self, backend: str, device: str, precision: str) -> float:
        if (backend, device) == ("reference", "cpu"):
            return 0.0
        got = tuple(result.cpu() for result in self.prepare(device)(backend))
        return largest_error(got, self.prepare("cpu")("reference"))


@dataclass(frozen=True)
class Agreement:
    """Makes cases which check that all `backends` agree with the reference.

    The tolerance depends on the inputs; `derivation` says how.
    """

    subject: str
    backends: Sequence[str]
    derivation: str

    def case(
        self,
        name: str,
        prepare: Prepare,
        tolerance: float,
        *,
        precision: str = "fp32",
        items: int | None = None,
    ) -> Case:
        """Make one case; it is timed if `items`, the number that a call processes, is given."""
        return Case(
            self.subject,
            name,
            "the result is that of the reference",
            self.derivation,
            {(backend, precision): tolerance for backend in self.backends},
            Difference(prepare),
            None if items is None else Timed(items, prepare),
        )


def on_backends(
    units: float, *precisions: str, backends: Sequence[str] = ("reference", "cpu")
) -> dict[Cell, float]:
    """Tolerances of `units` u, for `backends` in fp32 and for the reference in `precisions`.

    Only the reference has other precisions than fp32.
    """
    cells = [(backend, "fp32") for backend in backends]
    cells += [("reference", precision) for precision in precisions]
    return {cell: units * torch.finfo(DTYPES[cell[1]]).eps / 2 for cell in cells}


def largest_error(results: Sequence[Tensor], reference: Sequence[Tensor]) -> float:
    """Largest |result - reference| over all outputs; inf if shapes or non-finite values differ."""
    worst = 0.0
    for got, want in zip(results, reference, strict=True):
        if got.shape != want.shape:
            return torch.inf
        got, want = got.detach().double(), want.detach().double()
        same = (got == want) | (got.isnan() & want.isnan())
        error = torch.where(same, 0, (got - want).abs()).nan_to_num(nan=torch.inf)
        worst = max(worst, error.max().item() if error.numel() else 0.0)
    return worst
