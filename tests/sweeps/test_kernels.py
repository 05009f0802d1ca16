"""`steerbench kernels`, `compile` and `stress`: a table, then JSON; what is wrong fails them."""

import fcntl
import subprocess
import sys
from functools import partial
from types import SimpleNamespace

import pytest

from bench.case import Case
from bench.errors import Unavailable
from reports.tables import Table
from sweeps.commands.compile import wrong_of
from sweeps.processes import lock_file
from tests.common import refusal

RIGHT = {
    "kernel": "encode", "case": "view", "backend": "cpu", "dtype": "float32", "error": 1e-7,
    "tolerance": 1e-6, "status": "ok", "ms": 12.5, "mitems_s": 10.4, "ratio": 31.0,
}  # fmt: skip
REFERENCE = {**RIGHT, "backend": "reference", "error": 0.0, "ms": 387.5, "ratio": 1.0}
SMALL = {**RIGHT, "case": "few", "ms": 2.5}
WRONG = {
    "kernel": "march", "case": "empty", "backend": "cpu", "dtype": "float32", "error": 0.5,
    "tolerance": 1e-6, "status": "wrong",
}  # fmt: skip


@pytest.fixture
def asked(monkeypatch) -> list[tuple[list[str], int]]:
    """The subjects that were timed, and how often; the rows are those above, by subject."""
    calls = []

    def timed_rows(cases, device, backends, repeats, log):
        calls.append(([case.subject for case in cases], repeats))
        assert {"reference", "cpu"} & set(backends)
        place = max(lock_file("auto").parent.glob("*.json"))
        with place.open() as file, pytest.raises(BlockingIOError):  # it is its turn
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return [row for row in (SMALL, REFERENCE, RIGHT, WRONG) if row["kernel"] in calls[-1][0]]

    def case(subject):
        return Case(subject, "view", "", "", {}, lambda *cell: 0.0)

    monkeypatch.setattr("methods.checks.found", lambda name: [case("encode"), case("march")])
    monkeypatch.setattr("sweeps.commands.checks.timed_rows", timed_rows)
    return calls


@pytest.fixture
def shown(monkeypatch) -> list[Table]:
    tables = []
    monkeypatch.setattr("sweeps.commands.checks.show", tables.append)
    return tables


def test_the_last_line_is_json_and_a_wrong_kernel_fails(steerbench, asked):
    outcome = steerbench("kernels", "--filter", "enc", "--repeats", "3")
    assert asked == [(["encode"], 3)]
    assert outcome.ok().json == [SMALL, REFERENCE, RIGHT]
    outcome = steerbench("kernels")
    assert outcome.status == 1
    assert "wrong" in outcome.out  # instead of a time
    assert outcome.json == [SMALL, REFERENCE, RIGHT, WRONG]


def test_a_fast_version_has_a_line_with_the_time_of_its_reference(steerbench, asked, shown):
    steerbench("kernels")
    (table,) = shown
    wrong, right, small = (dict(zip(table.columns, line, strict=True)) for line in table.lines)
    assert wrong["kernel"] == "march"  # first, then those that save most
    assert [right[x] for x in ("error", "tolerance")] == ["1.0e-07", "1.0e-06"]
    assert [right[x] for x in ("ms", "by its reference", "ratio")] == ["12.50", "387.50", "31.0x"]
    assert right["M items/s"] == "10.40"
    assert small["by its reference"] == "n/a"


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("kernels --filter x", "no kernel has 'x' in its name"),
        ("stress --filter x", "no subject or case has 'x' in it"),
        ("experiments scene=wires", "unknown argument 'scene=wires'"),
    ],
)
def test_a_filter_or_a_setting_that_fits_nothing_is_an_error(steerbench, asked, argv, said):
    assert said in steerbench(*argv.split()).refused()


def test_compiled_kernels_compute_their_quick_cases(monkeypatch):
    tolerances = {("cpu", "fp32"): 0.1, ("reference", "fp32"): 0.1}
    computed = []

    def case(name, error, slow=False):
        def measure(backend, device, precision):
            computed.append((name, backend, precision))
            if isinstance(error, Unavailable):
                raise error
            return error

        return Case("march", name, "", "", tolerances, measure, slow=slow)

    cases = [case("right", 0.0), case("wrong", 0.5), case("slow", 0.5, slow=True)]
    cases.append(case("unavailable", Unavailable("no such products")))
    monkeypatch.setitem(sys.modules, "stand_in", SimpleNamespace(cases=lambda: cases))
    assert wrong_of("stand_in") == ["march: wrong"]
    # What is not compiled is left out.
    assert computed == [(name, "cpu", "fp32") for name in ("right", "wrong", "unavailable")]


@pytest.mark.slow
def test_compile_computes_the_cases_of_all_modules_in_processes(steerbench, monkeypatch):
    monkeypatch.setattr("methods.checks.modules", lambda name: ["methods.kernels.shade.cases"])
    assert steerbench("compile").status == 0
    monkeypatch.setattr("methods.checks.modules", lambda name: ["methods.kernels.shade"])
    with refusal("has no attribute 'cases'", AttributeError):
        steerbench("compile")


def test_compile_takes_what_the_named_methods_import():
    """In a process of its own: here, other tests have imported more."""
    code = "from sweeps.commands.compile import needed; print(*needed(['ngp', 'gaussians']))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(ran.stdout.split())
    assert {"methods.kernels.encode.cases", "methods.gaussians.kernels.ssim.cases"} < modules
    assert not any("diver" in module or "kilonerf" in module for module in modules)


# stress


def test_the_last_line_of_stress_is_json_and_a_case_that_fails_fails_it(steerbench, monkeypatch):
    cells = {("reference", "fp32"): 1e-6}
    errors = {"sum": 5e-7, "product": 2}
    cases = [
        Case(subject, "long", "all is there", "u", cells, lambda *cell, error=error: error)
        for subject, error in errors.items()
    ]
    monkeypatch.setattr("methods.checks.found", lambda name: cases)
    outcome = steerbench("stress", "--filter", "sum").ok()
    for text in ("sum", "long", "all is there", "reference", "fp32", "5.0e-07", "1.0e-06", "ok"):
        assert text in outcome.out
    (row,) = outcome.json
    assert (row["subject"], row["error"], row["status"]) == ("sum", 5e-7, "ok")
    outcome = steerbench("stress")
    assert outcome.status == 1
    assert "2 cases, 2 cells, 1 failed" in outcome.out
    assert [row["status"] for row in outcome.json] == ["ok", "failed"]


def test_cases_nearest_to_their_tolerances_are_shown_again(steerbench, shown, monkeypatch):
    seen = {"cpu": 5e-7, "reference": 4e-7, "gpu": Unavailable("no GPU")}
    cells = {("cpu", "fp32"): 1e-6, ("reference", "fp32"): 5e-7, ("gpu", "fp32"): 1e-6}

    def worst(backend, device, precision, share):
        if isinstance(seen[backend], Unavailable):
            raise seen[backend]
        return share * seen[backend]

    cases = [
        Case("sum", str(number), "all is there", "u", cells, partial(worst, share=number / 9))
        for number in range(10)
    ]
    monkeypatch.setattr("methods.checks.found", lambda name: cases)
    steerbench("stress")
    nearest = shown[-1].lines
    assert [line[1] for line in nearest] == ["9", "8", "7", "6", "5"]
    assert nearest[0][3:] == ("reference", "cpu", "fp32", "4.0e-07", "5.0e-07", "ok")
