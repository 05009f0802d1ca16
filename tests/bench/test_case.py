"""The runner of cases: a crash is a fail, and a backend that is wrong gets no time."""

import math
from collections.abc import Callable

import pytest
import torch

from bench.case import Bound, Case, Operation, failed, largest_error, nearest, run_cases, timed_rows
from bench.types import Unavailable

CELLS = {("cpu", "fp32"): 1e-6, ("reference", "fp64"): 1e-15}


def case(worst: Callable[[str, str, str], float]) -> Case:
    return Case("sum", "long", "nothing is lost", "u", CELLS, worst)


@pytest.mark.parametrize(
    ("seen", "status", "error"),
    [
        (0.0, "ok", 0.0),
        (1e-6, "ok", 1e-6),
        (1.1e-6, "failed", 1.1e-6),
        (math.nan, "failed", None),
        (math.inf, "failed", None),
        (ZeroDivisionError("by zero"), "failed: ZeroDivisionError: by zero", None),
        (Unavailable("no such library"), "unavailable: no such library", None),
    ],
)
def test_an_error_is_held_against_the_tolerance_of_its_cell(seen, status, error):
    def worst(backend, device, precision):
        if isinstance(seen, Exception):
            raise seen
        return seen

    row = case(worst).check(("cpu", "fp32"), "cpu")
    assert (row["status"], row["error"]) == (status, error)
    assert failed(row) == status.startswith("failed")


def test_every_cell_of_every_case_gets_a_row(quiet_log):
    asked = []

    def worst(backend, device, precision):
        asked.append((backend, device, precision))
        return 0.0

    rows = list(run_cases([case(worst), case(worst)], ["cuda"], quiet_log))
    assert asked == 2 * [("cpu", "cuda", "fp32"), ("reference", "cuda", "fp64")]
    assert [(row["backend"], row["precision"]) for row in rows] == 2 * list(CELLS)
    assert [row["tolerance"] for row in rows] == 2 * list(CELLS.values())


def scaled(wrong: str) -> Operation:
    """x y of a list of tensors x and a tensor y; backend "cpu" gets one result wrong by 1/8."""

    def compute(x, y, backend):
        off, x = 0.125 * (backend == "cpu"), sum(x)
        if wrong == "gradient":
            x = x + off * (x - x.detach())
        return x * y + off * (wrong == "second"), y + off * (wrong == "last")

    outputs = {"second": Bound("a", 0.1), "last": Bound("b", lambda given: given["y"].abs())}
    gradients = {"x": Bound("c", torch.tensor(0.01))}
    backends = ("reference", "cpu")
    return Operation("scaled", backends, compute, outputs, gradients, lambda _, *x: torch.ones(x))


@pytest.mark.parametrize(
    ("wrong", "forward", "backward"),
    [
        ("nothing", "ok 0.0", "ok 0.0"),
        ("second", "failed 0.125 0.1", "failed 0.125 0.1"),
        ("last", "failed 0.125 0.0625", "failed 0.125 0.0625"),
        ("gradient", "ok 0.0", "failed 0.125 0.01"),
    ],
)
def test_each_result_of_an_operation_has_its_own_tolerance(wrong, forward, backward):
    inputs = {"x": [torch.ones(2), torch.ones(2)], "y": torch.tensor([1.0, 0.0625])}
    there, back = scaled(wrong).cases("two", lambda: inputs)
    assert (there.subject, back.subject) == ("scaled", "scaled backward")
    assert back.derivation == "second: a; last: b; gradient of x: c"
    for case, want in ((there, forward), (back, backward)):
        row = case.check(("cpu", "fp32"), "cpu")
        got = row["status"], row["error"], round(row["tolerance"], 6)
        assert " ".join(map(str, got)).startswith(want), row
    assert not inputs["y"].requires_grad


def test_the_number_nearest_to_its_tolerance_is_reported():
    zero, off = torch.zeros(3), torch.tensor([0.5, 0.02, 0.0])
    tolerance = torch.tensor([1.0, 0.01, 0.0])
    assert nearest((off,), (zero,), (tolerance,)) == pytest.approx((0.02, 0.01))
    assert nearest((off, zero), (zero, off), (1.0, 0.1)) == (0.5, pytest.approx(0.1))
    assert nearest((zero[:2],), (zero,), (1.0,)).error == torch.inf
    for wrong in (torch.nan, torch.inf):
        assert largest_error((torch.tensor([wrong]),), (torch.ones(1),)) == torch.inf
    assert nearest((zero[:0],), (zero[:0],), (tolerance[:0],)) == (0.0, 0.0)


def fake(subject: str, *backends: str) -> Operation:
    """Backend "cpu" is `off`."""
    bound = Bound("", 0.5)
    return Operation(
        subject, backends, lambda off, backend: off * (backend == "cpu"), {"off": bound}
    )


@pytest.mark.parametrize("items", [0, 10_000])
def test_a_backend_that_is_wrong_on_any_case_of_a_kernel_gets_no_time(items, quiet_log):
    kernel = fake("fake", "reference", "cpu", "gpu")
    other = fake("other", "reference", "cpu")
    right, wrong = ({"off": torch.full((1,), off)} for off in (0.0, 1.0))
    cases = [
        *kernel.cases("large", lambda: right, items=10_000),
        *kernel.cases("no sample", lambda: wrong, items=items),
        *other.cases("large", lambda: right, items=10_000),
        *fake("never timed", "cpu").cases("small", lambda: wrong),
    ]
    found = timed_rows(cases, "cpu", ("reference", "cpu"), 2, quiet_log)
    rows = {(row["kernel"], row["backend"]): row for row in found if row["case"] == "large"}
    assert rows["fake", "reference"]["status"] == "ok"
    assert rows["fake", "reference"]["ratio"] == 1
    assert rows["fake", "cpu"]["status"] == "wrong: no sample"
    assert "ms" not in rows["fake", "cpu"]
    assert rows["other", "cpu"]["status"] == "ok"
    assert rows["other", "cpu"]["mitems_s"] > 0
    assert {row["backend"] for row in found} == {"reference", "cpu"}
    assert {row["kernel"] for row in found} == {"fake", "other"}
