"""Functions of all kernels for the CPU: the exponential against float64, rounding against torch;
which machine code is kept."""

import math
import os
import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
from numba import njit

from bench.case import U32
from methods.kernels.cpu import EDGE, exp, pack_bf16
from tests.common import ROOT


@njit
def _all(x: np.ndarray, out: np.ndarray) -> None:
    for i in range(len(x)):
        out[i] = exp(x[i])


def test_it_is_exact_to_three_roundings_between_its_ends_and_held_beyond_them():
    x = np.linspace(-EDGE, EDGE, 100_001, dtype=np.float32)
    x = np.concatenate((x, np.float32([-math.inf, math.inf, math.nan])))
    out = np.empty_like(x)
    _all(x, out)
    assert np.abs(out[:-3] / np.exp(x[:-3].astype(np.float64)) - 1).max() <= 3 * U32
    assert out[-3:-1].tolist() == [out[0], out[-4]]
    assert math.isnan(out[-1])


BITS = [0x7FFFFFFF, 0xFFFFFFFF, 0x7F800001, 0x7FC00000, 0x7F800000, 0xFF800000, 0x7F7FFFFF]
"""Those of four NaN, +inf, -inf and the largest number, which rounds to +inf."""


@pytest.mark.parametrize("bits", [*BITS, 0x3F808000, 0x3F818000, 0x3F808001, 0x80000000, 1])
def test_numbers_are_rounded_to_bfloat16_as_torch_does(bits):
    number = torch.tensor([bits]).to(torch.uint32).view(torch.float32)
    other = torch.tensor([1.0])
    for pair in ((number, other), (other, number)):
        word = pack_bf16(*(x.numpy()[0] for x in pair))
        got = torch.tensor([int(word)]).to(torch.uint32).view(torch.bfloat16)
        assert torch.equal(got.nan_to_num(), torch.cat(pair).bfloat16().nan_to_num())
        assert torch.equal(got.isnan(), torch.cat(pair).isnan())


CALLER = """
import numpy as np
from methods.kernels.cpu import exp, jit

@jit()
def called(x):
    return exp(x)

print(round(called(np.float32(2))), *called.stats.cache_hits.values())
"""


@pytest.mark.slow
def test_machine_code_is_used_until_a_file_changes_that_it_comes_from(tmp_path):
    apart = shutil.ignore_patterns("__pycache__", "scenes")
    for package in ("bench", "methods/kernels"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=apart)
    shutil.copy(ROOT / "methods/__init__.py", tmp_path / "methods")
    caller, shared = tmp_path / "methods/caller", tmp_path / "methods/kernels/cpu.py"
    caller.mkdir()
    (caller / "__init__.py").touch()
    (caller / "cpu.py").write_text(CALLER)

    def called():
        command = [sys.executable, "-c", "import methods.caller.cpu"]
        given = {**os.environ, "PYTHONPATH": str(tmp_path), "NUMBA_CACHE_DIR": ""}
        done = subprocess.run(command, cwd=tmp_path, env=given, capture_output=True, text=True)
        return done.stdout.strip() or done.stderr

    assert called() == "7"
    assert called() == "7 1"  # loaded
    shared.write_text(shared.read_text().replace("EDGE = f32(87)", "EDGE = f32(0)"))
    assert called() == "1"
    assert len(list(caller.glob("__pycache__/machine-code-*"))) == 1
