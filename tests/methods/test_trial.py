"""The trial of Triton's kernels on a GPU, with children that play the kernels."""

import math
import sys

import torch

from bench.case import Case, Difference
from methods import trial
from methods.instant_ngp.training import FieldTraining
from methods.kernels import dispatch
from methods.trial import Verdict, examined, tried, verdicts

CHILD = """
import json, os, sys, time
kernel = sys.argv[1]
if kernel == "crashes":
    print("begun\\nout of reach", file=sys.stderr)
    os._exit(3)
if kernel == "hangs":
    time.sleep(1000)
print(json.dumps({"right": [3.0, ""], "slower": [0.5, ""], "wrong": [None, "off"]}[kernel]))
"""


def test_a_kernel_that_crashes_hangs_or_is_wrong_takes_no_other_with_it():
    faults = {"wrong": "off", "crashes": "exit status 3: out of reach", "right": ""}
    faults |= {"hangs": "not done after 3 s", "slower": ""}
    found = tried(list(faults), [sys.executable, "-c", CHILD], limit_s=3.0)
    assert [(name, verdict.fault) for name, verdict in found.items()] == [*faults.items()]
    assert [name for name, verdict in found.items() if verdict.trusted] == ["right"]


def a_case(compute, **options):
    def prepare(device):
        return lambda backend: (torch.as_tensor(compute(backend)),)

    cells = {("reference", "fp32"): None, ("gpu", "fp32"): None, ("cpu", "fp32"): None}
    error = Difference(prepare, lambda: [1e-6])
    return Case("kernel", "a case", "equal", "", cells, error, **options)


def test_all_cases_of_a_kernel_are_checked_and_those_that_are_long_enough_are_timed():
    right, timed = a_case(lambda backend: 1.0), a_case(lambda backend: 1.0, timed=1)
    wrong = a_case(lambda backend: float(backend == "gpu"))
    raises = a_case(lambda backend: 1 / (backend != "gpu"))
    assert examined([timed], "cpu").ratio > 0
    assert examined([timed, wrong], "cpu").fault == "kernel, a case: failed"
    assert "ZeroDivisionError" in examined([timed, raises], "cpu").fault
    assert not examined([right], "cpu").trusted  # it was not timed


def test_what_agrees_and_is_faster_is_taken_and_kept(monkeypatch, tmp_path, capsys):
    """`auto` on a GPU; the verdicts are kept until the GPU changes, and the row names what ran."""
    played = {name: [2.0, ""] for name in ("encode", "march", "shade")}
    played |= {"adam": [math.nan, "off"], "composite": [0.5, ""]}
    tries = []

    def play(kernels, command, limit_s):
        tries.append(command[-1])
        return {name: Verdict(*played[name.rpartition(".")[2]]) for name in kernels}

    monkeypatch.setattr(trial, "tried", play)
    monkeypatch.setattr(dispatch, "availability", lambda: {"gpu": ""})
    monkeypatch.setattr(dispatch, "interpreted", lambda: False)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    device = torch.device("cuda:0")
    for name in ("one GPU", "one GPU", "another GPU"):
        verdicts.cache_clear()
        monkeypatch.setattr(torch.cuda, "get_device_name", lambda device, name=name: name)
        assert dispatch.resolve("auto", device) == "auto"
        said = dispatch.by_kernel("auto", FieldTraining, device)
        assert said == "gpu, but reference: adam, composite, mlp"
    verdicts.cache_clear()
    assert tries == ["cuda:0", "cuda:0"]
    assert "adam: off; composite: 0.5x as fast" in capsys.readouterr().err
