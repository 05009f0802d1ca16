"""A case: one check, what must hold and within which tolerance. Runs and times cases.

Each folder keeps its cases in `cases.py`. A tolerance is derived from the arithmetic, in units of
the unit roundoff u of the type that the result is computed in, never from an observed error.
"""

import math
import statistics
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import cache, partial
from itertools import product
from typing import Any, NamedTuple

import torch
from torch import Tensor

from bench.clock import times_ms
from bench.kinds import Row, Rows
from bench.types import Log, SomeTensors, Unavailable

Cell = tuple[str, str]  # a backend or an engine, and a precision
Computation = Callable[[str], tuple[Tensor, ...]]  # computes the outputs with a backend
Given = Mapping[str, Any]  # the inputs of an operation, by name
Tolerance = float | Tensor  # the largest allowed error of a result, or of each of its numbers

DTYPES = {
    "fp64": torch.float64,
    "fp32": torch.float32,
    "fp16": torch.float16,
    "bf16": torch.bfloat16,
}

U32 = 2.0**-24  # unit roundoff of float32
U16 = 2.0**-8
"""Unit roundoff of bfloat16, and its ulp from 1/2 to 1: two nearly equal numbers below 1 may round
to neighbours."""


LEAST_TIMED = 2000  # samples, rays or entries a call: fewer are done in too short a time


class Random:
    """Random numbers of a seed: what they are depends on what was drawn before."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def share(self, *shape: int) -> Tensor:
        """From 0 to 1."""
        return torch.rand(shape, generator=self.generator)

    def signed(self, *shape: int) -> Tensor:
        """From -1 to 1."""
        return 2 * self.share(*shape) - 1

    def normal(self, *shape: int) -> Tensor:
        """Of mean 0 and variance 1."""
        return torch.randn(shape, generator=self.generator)

    def whole(self, low: int, end: int, *shape: int) -> Tensor:
        """Integers from `low` to less than `end`."""
        return torch.randint(low, end, shape, generator=self.generator)


class Deviation(NamedTuple):
    """An error, and the largest one that is allowed there."""

    error: float
    tolerance: float


@dataclass(frozen=True)
class Case:
    """A property that must hold for every backend or engine."""

    subject: str  # the computation that is checked ("composite backward")
    name: str  # what is special about the inputs
    holds: str  # what must hold
    derivation: str  # where the tolerances come from
    tolerances: Mapping[Cell, float | None]  # the largest allowed errors; None: `error` says it
    # The largest error, given backend, device and precision; Unavailable if there are none such.
    error: Callable[[str, str, str], float | Deviation]
    timed: int | None = None  # samples, rays or entries a call; None: too few to time
    slow: bool = False  # takes more than a moment, so the tests skip it

    @property
    def quick(self) -> bool:
        """Whether its inputs are few, so that checking it takes but a moment."""
        return not (self.slow or self.timed)

    def check(self, cell: Cell, device: str) -> Row:
        """Check one cell; "status" is "ok", "failed", or "failed: " or "unavailable: " and why."""
        backend, precision = cell
        error, tolerance = math.inf, self.tolerances[cell]
        try:
            found = self.error(backend, device, precision)
            error, tolerance = found if isinstance(found, Deviation) else (found, tolerance)
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


Cases = list[Case]


@dataclass(frozen=True)
class Property:
    """A property that several cases check, with the same tolerances; see `Case`."""

    subject: str
    holds: str
    derivation: str
    tolerances: Mapping[Cell, float]

    def case(self, name: str, error: Callable[..., float], *settings: object) -> Case:
        """A case that calls `error` with `settings` first."""
        return Case(name=name, error=partial(error, *settings), **vars(self))


@dataclass(frozen=True)
class Difference:
    """Computes how far results are from those of the reference backend on the CPU, where they are
    nearest to their `tolerances`."""

    prepare: Callable[[str], Computation]  # makes the inputs on a device
    tolerances: Callable[[], Sequence[Tolerance]]

    def __call__(self, backend: str, device: str, precision: str) -> Deviation:
        if (backend, device) == ("reference", "cpu"):
            return Deviation(0.0, 0.0)
        got, want = self.prepare(device)(backend), self.prepare("cpu")("reference")
        return nearest(got, want, self.tolerances())


@dataclass(frozen=True)
class Bound:
    """How far a result may be from that of the reference."""

    why: str  # where it comes from
    off: Tolerance | Callable[[Given], Tolerance]  # may depend on the inputs, on the CPU

    def of(self, given: Given) -> Tolerance:
        return self.off(given) if callable(self.off) else self.off


@dataclass(frozen=True)
class Operation:
    """An operation; all its `backends` agree with the reference, forward and backward."""

    subject: str
    backends: Sequence[str]
    compute: Callable[..., Any]  # its results, of the inputs by name and a `backend`
    outputs: Mapping[str, Bound]  # of each result, by its name, in their order
    gradients: Mapping[str, Bound] = field(default_factory=dict)  # of an input or a list of them
    draw: Callable[..., Tensor] = Random.signed  # gradients of the results, of a `Random` and sizes
    relative: bool = False  # gradients are compared in units of the largest number of each

    def cases(
        self,
        name: str,
        make: Callable[..., Given],
        *settings: object,
        precision: str = "fp32",
        items: int = 0,
    ) -> Cases:
        """The cases with the inputs that `make` makes of `settings` on the CPU: one of the outputs
        and, if there are gradients, one of outputs and gradients. They are timed if `items`, the
        number that a call processes, is at least `LEAST_TIMED`."""
        given = partial(make, *settings)
        ways: list[tuple[str, Mapping[str, Bound]]] = [(self.subject, {})]
        if self.gradients:
            ways.append((f"{self.subject} backward", self.gradients))
        found = []
        for subject, gradients in ways:
            bounds = {**self.outputs, **{f"gradient of {k}": v for k, v in gradients.items()}}
            prepare = partial(self._prepare, given, tuple(gradients))
            case = Case(
                subject,
                name,
                "the result is that of the reference",
                "; ".join(f"{result}: {bound.why}" for result, bound in bounds.items()),
                dict.fromkeys((backend, precision) for backend in self.backends),
                Difference(prepare, partial(self._tolerances, given, gradients)),
                items if items >= LEAST_TIMED else None,
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
            random = Random(1)
            return [self.draw(random, *shape).to(device) for shape in shapes]

        def call(backend: str) -> tuple[Tensor, ...]:
            results = self._results(self.compute(**given, backend=backend))
            if not wanted:
                return results
            lit = [x for x in results if x.requires_grad]
            shapes = (x.shape for x in lit)
            grads = [grad.to(x.dtype) for x, grad in zip(lit, shine(*shapes), strict=True)]
            found = torch.autograd.grad(
                lit,
                wanted,
                grads,
                materialize_grads=True,
            )
            if self.relative:
                found = tuple(x / x.abs().max().clamp(min=1e-30) if len(x) else x for x in found)
            return (*(x.detach() for x in results), *found)

        return call

    def _results(self, computed: Any) -> tuple[Tensor, ...]:
        """A tensor, several, or those of an object that are called like the outputs."""
        if isinstance(computed, Tensor):
            return (computed,)
        if isinstance(computed, tuple):
            return computed
        return tuple(getattr(computed, name) for name in self.outputs)

    def _tolerances(
        self, make: Callable[[], Given], gradients: Mapping[str, Bound]
    ) -> list[Tolerance]:
        given = make()
        bounds = list(self.outputs.values())
        for name, bound in gradients.items():
            bounds += [bound] * len(_several(given[name]))
        return [bound.of(given) for bound in bounds]


def _several(value: Tensor | SomeTensors) -> SomeTensors:
    return [value] if isinstance(value, Tensor) else value


def placed(value: Any, device: str, precision: str = "") -> Any:
    """The tensors in mappings, lists and dataclasses on `device`, detached; those of floating-point
    numbers in a `precision`, if that is given."""

    def moved(part: Any) -> Any:
        return placed(part, device, precision)

    if isinstance(value, Tensor):
        rounded = precision and value.is_floating_point()
        return value.detach().to(device, DTYPES[precision] if rounded else value.dtype)
    if isinstance(value, Mapping):
        return {name: moved(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [moved(item) for item in value]
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: moved(getattr(value, f.name)) for f in fields(value)})
    return value


def on_backends(
    units: float, *precisions: str, backends: Sequence[str] = ("reference", "cpu")
) -> dict[Cell, float]:
    """Tolerances of `units` u: of `backends` in fp32, of the reference alone in `precisions`."""
    cells = [*product(backends, ("fp32",)), *product(("reference",), precisions)]
    return {cell: units * torch.finfo(DTYPES[cell[1]]).eps / 2 for cell in cells}


def nearest(
    results: SomeTensors, reference: SomeTensors, tolerances: Sequence[Tolerance]
) -> Deviation:
    """The error of that number of all results which is nearest to its tolerance, or exceeds it by
    the largest factor; inf if shapes or non-finite values differ."""
    worst, nearness = Deviation(0.0, 0.0), -1.0
    for got, want, allowed in zip(results, reference, tolerances, strict=True):
        error = _errors(got, want)
        if not error.numel():
            continue
        tolerance = torch.as_tensor(allowed, dtype=torch.float64).expand_as(error).flatten()
        error = error.flatten()
        share = torch.where(error > 0, error / tolerance, 0)
        at = int(share.argmax())
        if share[at] > nearness:
            nearness, worst = share[at].item(), Deviation(error[at].item(), tolerance[at].item())
    return worst


def largest_error(results: SomeTensors, reference: SomeTensors) -> float:
    """Largest |result - reference| over all outputs; inf if shapes or non-finite values differ."""
    return nearest(results, reference, [1.0] * len(results)).error


def _errors(got: Tensor, want: Tensor) -> Tensor:
    """|got - want| in float64 on the CPU; inf where only one is NaN or infinite, or if shapes
    differ."""
    if got.shape != want.shape:
        return torch.full((1,), torch.inf, dtype=torch.float64)
    got, want = (x.detach().cpu().double() for x in (got, want))
    same = (got == want) | (got.isnan() & want.isnan())
    error = torch.where(same, 0, (got - want).abs())
    return torch.where(error.isnan(), torch.inf, error)


def run_cases(cases: Sequence[Case], devices: Sequence[str], log: Log) -> Iterator[Row]:
    """Check all cells of `cases` on all `devices`, and yield their rows; see `Case.check`."""
    cells = sum(len(case.tolerances) for case in cases)
    with log.progress("stress", cells * len(devices)) as progress:
        for case, device in product(cases, devices):
            for cell in case.tolerances:
                progress.advance(0, note=f"{case.subject}, {case.name}: {' '.join(cell)}")
                yield case.check(cell, device)
                progress.advance(note="")


def failed(row: Mapping[str, Any]) -> bool:
    return row["status"].startswith("failed")


def timed_rows(
    cases: Sequence[Case], device: str, backends: Collection[str], repeats: int, log: Log
) -> Rows:
    """Check the cases and time the correct ones; one row per timed case and supported backend.

    A backend that fails any case of a kernel, timed or not, is not timed; its status names these
    cases. ms is the median of `repeats`, mitems_s million items a second, ratio the time of the
    reference over that of this backend.
    """
    subjects = {case.subject for case in cases if case.timed}
    checked = [case for case in cases if case.subject in subjects and not case.slow]
    results: list[tuple[Case, Difference, Rows]] = []
    wrong: dict[tuple[str, str], list[str]] = {}
    with log.progress("kernels", len(checked) + sum(bool(c.timed) for c in checked)) as progress:
        for case in checked:
            checks = [case.check(cell, device) for cell in case.tolerances if cell[0] in backends]
            for check in filter(failed, checks):
                wrong.setdefault((case.subject, check["backend"]), []).append(case.name)
            if case.timed and isinstance(case.error, Difference):
                results.append((case, case.error, checks))
            progress.advance(note=f"{case.subject}, {case.name}")
        rows = []
        for case, compared, checks in results:
            for check in checks:
                if names := wrong.get((case.subject, check["backend"])):
                    check["status"] = f"wrong: {', '.join(names)}"
            correct = [check["backend"] for check in checks if check["status"] == "ok"]
            compute = compared.prepare(device)
            of_each = times_ms([partial(compute, name) for name in correct], repeats, device)
            times = dict(zip(correct, map(statistics.median, of_each), strict=True))
            rows += [_row(case, check, times) for check in checks]
            progress.advance(note=f"timed: {case.subject}, {case.name}")
    return rows


def _row(case: Case, check: Mapping[str, Any], times: Mapping[str, float]) -> Row:
    backend = check["backend"]
    row = {
        "kernel": case.subject,
        "case": case.name,
        "backend": backend,
        "dtype": check["precision"],
        **{key: check[key] for key in ("error", "tolerance", "status")},
    }
    if case.timed and backend in times:
        row["ms"] = times[backend]
        row["mitems_s"] = case.timed / times[backend] / 1e3
        if "reference" in times:
            row["ratio"] = times["reference"] / times[backend]
    return row
