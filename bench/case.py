"""A case: one check, what must hold and within which tolerance.

Each folder keeps its cases in `cases.py`. A tolerance is derived from the arithmetic, in units of
the unit roundoff u of the type that the result is computed in, never from an observed error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bench.types import Unavailable

Cell = tuple[str, str]
"""A backend or an engine, and a precision."""

Computation = Callable[[str], tuple[Tensor, ...]]
"""Computes the outputs with a backend."""

Prepare = Callable[[str], Computation]
"""Makes inputs on a device and returns a function of the backend that computes the outputs."""

Given = Mapping[str, Any]
"""The inputs of an operation, by name."""

Tolerance = float | Tensor
"""The largest allowed error of a result, or one of each of its numbers."""

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


class Apart(NamedTuple):
    """An error, and the largest one that is allowed there."""

    error: float
    tolerance: float


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
        tolerances: the largest allowed error of each cell; None: `error` says it.
        error: computes the largest error, given backend, device and precision, or `Apart` where it
            is nearest to what is allowed. Raises `Unavailable` if the cell does not exist on that
            device.
        timed: None if there are too few inputs for a meaningful throughput.
        slow: takes more than a moment, so the tests skip it.
    """

    subject: str
    name: str
    holds: str
    derivation: str
    tolerances: Mapping[Cell, float | None]
    error: Callable[[str, str, str], float | Apart]
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
            found = self.error(backend, device, precision)
            error, tolerance = found if isinstance(found, Apart) else (found, tolerance)
            assert tolerance is not None
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

    def case(self, name: str, error: Callable[[str, str, str], float]) -> Case:
        """Make one case of the property."""
        return Case(self.subject, name, self.holds, self.derivation, self.tolerances, error)


@dataclass(frozen=True)
class Difference:
    """Computes how far results are from those of the reference backend on the CPU, where they are
    nearest to their `tolerances`."""

    prepare: Prepare
    tolerances: Callable[[], Sequence[Tolerance]]

    def __call__(self, backend: str, device: str, precision: str) -> Apart:
        if (backend, device) == ("reference", "cpu"):
            return Apart(0.0, 0.0)
        got = tuple(result.cpu() for result in self.prepare(device)(backend))
        return nearest(got, self.prepare("cpu")("reference"), self.tolerances())


@dataclass(frozen=True)
class Bound:
    """How far a result may be from that of the reference.

    Attributes:
        why: where it comes from.
        off: the tolerance, or a function of the inputs, on the CPU, that computes it.
    """

    why: str
    off: Tolerance | Callable[[Given], Tolerance]

    def of(self, given: Given) -> Tolerance:
        """The tolerance for the inputs `given`."""
        return self.off(given) if callable(self.off) else self.off


def uniform(generator: torch.Generator, shape: Sequence[int]) -> Tensor:
    """Random numbers from -1 to 1."""
    return 2 * torch.rand(tuple(shape), generator=generator) - 1


@dataclass(frozen=True)
class Operation:
    """An operation; all its `backends` agree with the reference, forward and backward.

    Attributes:
        subject: its name.
        compute: its results, a tuple, given the inputs and the backend.
        outputs: the bound of each result, by its name, in their order.
        gradients: the bound of the gradient of an input, by the name of the input, which is a
            tensor or a list of them. There are no other gradients.
        draw: the gradients of the results, at random.
        relative: gradients are compared in units of the largest number of each.
    """

    subject: str
    backends: Sequence[str]
    compute: Callable[[Given, str], tuple[Tensor, ...]]
    outputs: Mapping[str, Bound]
    gradients: Mapping[str, Bound] = field(default_factory=dict)
    draw: Callable[[torch.Generator, Sequence[int]], Tensor] = uniform
    relative: bool = False

    def cases(
        self,
        name: str,
        make: Callable[[], Given],
        *,
        precision: str = "fp32",
        items: int | None = None,
    ) -> list[Case]:
        """The cases with the inputs that `make` makes on the CPU: one of the outputs and, if there
        are gradients, one of outputs and gradients. They are timed if `items`, the number that a
        call processes, is given."""
        ways: list[tuple[str, Mapping[str, Bound]]] = [(self.subject, {})]
        if self.gradients:
            ways.append((f"{self.subject} backward", self.gradients))
        found = []
        for subject, gradients in ways:
            bounds = {**self.outputs, **{f"gradient of {k}": v for k, v in gradients.items()}}
            prepare = partial(self._prepare, make, tuple(gradients))
            case = Case(
                subject,
                name,
                "the result is that of the reference",
                "; ".join(f"{result}: {bound.why}" for result, bound in bounds.items()),
                dict.fromkeys((backend, precision) for backend in self.backends),
                Difference(prepare, partial(self._tolerances, make, gradients)),
                None if items is None else Timed(items, prepare),
            )
            found.append(case)
        return found

    def _prepare(
        self, make: Callable[[], Given], learned: Sequence[str], device: str
    ) -> Computation:
        """Computes the outputs, then the gradients of the inputs `learned`."""
        given = placed(make(), device)
        wanted = [x.requires_grad_() for name in learned for x in _several(given[name])]

        @cache
        def shine(*shapes: torch.Size) -> list[Tensor]:
            generator = torch.Generator().manual_seed(1)
            return [self.draw(generator, shape).to(device) for shape in shapes]

        def call(backend: str) -> tuple[Tensor, ...]:
            results = self.compute(given, backend)
            if not wanted:
                return results
            lit = [x for x in results if x.requires_grad]
            drawn = zip(lit, shine(*(x.shape for x in lit)), strict=True)
            grads = [grad.to(x.dtype) for x, grad in drawn]
            found = torch.autograd.grad(lit, wanted, grads, materialize_grads=True)
            if self.relative:
                found = tuple(x / x.abs().max().clamp(min=1e-30) if len(x) else x for x in found)
            return (*(x.detach() for x in results), *found)

        return call

    def _tolerances(
        self, make: Callable[[], Given], gradients: Mapping[str, Bound]
    ) -> list[Tolerance]:
        given = make()
        each = [(bound, 1) for bound in self.outputs.values()]
        each += [(bound, len(_several(given[name]))) for name, bound in gradients.items()]
        return [bound.of(given) for bound, count in each for _ in range(count)]


def _several(value: Tensor | Sequence[Tensor]) -> Sequence[Tensor]:
    return [value] if isinstance(value, Tensor) else value


def placed(value: Any, device: str) -> Any:
    """The tensors in mappings, lists and dataclasses on `device`, detached."""
    if isinstance(value, Tensor):
        return value.detach().to(device)
    if isinstance(value, Mapping):
        return {name: placed(item, device) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [placed(item, device) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{f.name: placed(getattr(value, f.name), device) for f in fields(value)}
        )
    return value


def on_backends(
    units: float, *precisions: str, backends: Sequence[str] = ("reference", "cpu")
) -> dict[Cell, float]:
    """Tolerances of `units` u, for `backends` in fp32 and for the reference in `precisions`.

    Only the reference has other precisions than fp32.
    """
    cells = [(backend, "fp32") for backend in backends]
    cells += [("reference", precision) for precision in precisions]
    return {cell: units * torch.finfo(DTYPES[cell[1]]).eps / 2 for cell in cells}


def nearest(
    results: Sequence[Tensor], reference: Sequence[Tensor], tolerances: Sequence[Tolerance]
) -> Apart:
    """The error of that number of all results which is nearest to its tolerance, or exceeds it by
    the largest factor; inf if shapes or non-finite values differ."""
    worst, nearness = Apart(0.0, 0.0), -1.0
    for got, want, allowed in zip(results, reference, tolerances, strict=True):
        error = _errors(got, want)
        if not error.numel():
            continue
        tolerance = torch.as_tensor(allowed, dtype=torch.float64).expand_as(error).flatten()
        error = error.flatten()
        share = torch.where(error > 0, error / tolerance, 0)
        at = int(share.argmax())
        if share[at] > nearness:
            nearness, worst = share[at].item(), Apart(error[at].item(), tolerance[at].item())
    return worst


def largest_error(results: Sequence[Tensor], reference: Sequence[Tensor]) -> float:
    """Largest |result - reference| over all outputs; inf if shapes or non-finite values differ."""
    errors = [_errors(got, want) for got, want in zip(results, reference, strict=True)]
    return max((x.max().item() for x in errors if x.numel()), default=0.0)


def _errors(got: Tensor, want: Tensor) -> Tensor:
    """|got - want| in float64; inf where only one is NaN or infinite, or if shapes differ."""
    if got.shape != want.shape:
        return torch.full((1,), torch.inf, dtype=torch.float64)
    got, want = got.detach().double(), want.detach().double()
    same = (got == want) | (got.isnan() & want.isnan())
    return torch.where(same, 0, (got - want).abs()).nan_to_num(nan=torch.inf)
