"""Which Triton kernels a GPU is trusted with: `backend=auto` takes those that are right and faster.

Before the kernels are first used on a GPU, their cases run there, against the reference and in
turns with it. Child processes do that, because a wrong kernel may crash or never end. The
verdicts are kept in Triton's cache, until the GPU, its driver, torch, Triton or the code changes.
"""

import json
import math
import statistics
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from functools import cache, partial
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import torch

from bench.case import Case, Difference, failed
from bench.clock import times_ms
from bench.console import ConsoleLog
from bench.kinds import Words
from bench.provenance import ROOT, libraries
from bench.sharing import locked, whole
from bench.types import Log
from methods import checks

LIMIT_S = 180.0  # for the cases of one kernel, most of it for Triton's compiler
REPEATS = 5


class Verdict(NamedTuple):
    """What was found of a kernel on a GPU."""

    ratio: float  # time of the reference / time of the kernel; NaN: not timed
    fault: str  # "" if it agrees with the reference

    @property
    def trusted(self) -> bool:
        return not self.fault and self.ratio > 1

    def __str__(self) -> str:
        return self.fault or f"{self.ratio:.2g}x as fast as the reference"


@cache
def verdicts(device: str) -> Mapping[str, Verdict]:
    """Of every kernel of Triton on the GPU `device`, by its package; see `tried_again`."""
    log, file = ConsoleLog(Path()), _file(device)
    with locked(file.with_suffix(".lock"), f"waits for another trial of {device}", log):
        if not file.exists():
            return tried_again(device, log)
    return {name: Verdict(*found) for name, found in json.loads(file.read_text()).items()}


def tried_again(device: str, log: Log) -> Mapping[str, Verdict]:
    """Try every kernel of Triton on the GPU `device`, tell `log`, and keep the verdicts."""
    name = torch.cuda.get_device_name(device)
    log.info(f"{name}: its kernels are tried against their reference, once")
    found = tried(checks.kernels("gpu"), [sys.executable, "-m", __name__, device], LIMIT_S)
    with whole(_file(device)) as new:
        new.write_text(json.dumps(found))
    said = "; ".join(f"{kernel.rpartition('.')[2]}: {found[kernel]}" for kernel in found)
    log.info(f"{name}: backend=auto takes the kernels that are right and faster. {said}")
    if any(verdict.fault for verdict in found.values()):
        log.info("please report the output of `steerbench kernels`, which tries them again")
    return found


def _file(device: str) -> Path:
    """Where the verdicts are kept, in a folder that is there."""
    gpu = import_module("methods.kernels.gpu")
    folders = "methods.kernels", *checks.kernels("gpu")
    files = (path for name in folders for path in ROOT.joinpath(*name.split(".")).glob("*.py"))
    code = {str(path): path.read_text() for path in sorted(files)}
    driver = Path("/proc/driver/nvidia/version")
    where = torch.cuda.get_device_name(device), driver.read_text() if driver.exists() else ""
    key = json.dumps([where, libraries(gpu.launch), code]).encode()
    folder = gpu.cache_folder() / "steerbench"
    folder.mkdir(parents=True, exist_ok=True)
    return folder / f"{sha256(key).hexdigest()[:16]}.json"


def tried(kernels: Sequence[str], command: Words, limit_s: float) -> dict[str, Verdict]:
    """The verdicts of children, `command` with the name of one of the `kernels` each, which have
    `limit_s` seconds."""
    return {kernel: _answer([*command, kernel], limit_s) for kernel in kernels}


def _answer(command: Words, limit_s: float) -> Verdict:
    try:
        done = subprocess.run(command, capture_output=True, timeout=limit_s, errors="replace")
    except subprocess.TimeoutExpired:
        return Verdict(math.nan, f"not done after {limit_s:.0f} s")
    if done.returncode:
        last = done.stderr.strip().rpartition("\n")[2]
        return Verdict(math.nan, f"exit status {done.returncode}: {last}")
    return Verdict(*json.loads(done.stdout))


def examined(cases: Sequence[Case], device: str) -> Verdict:
    """Check all `cases` of a kernel on `device`, then time those that are to be timed."""
    for case in cases:
        for cell in case.tolerances:
            if cell[0] == "gpu" and not case.slow and failed(row := case.check(cell, device)):
                return Verdict(math.nan, f"{case.subject}, {case.name}: {row['status']}")
    took = {"reference": 0.0, "gpu": 0.0}
    for case in cases:
        if case.timed and isinstance(case.error, Difference):
            compute = case.error.prepare(device)
            of_each = times_ms([partial(compute, name) for name in took], REPEATS, device)
            for name, times in zip(took, of_each, strict=True):
                took[name] += statistics.median(times)
    return Verdict(took["reference"] / took["gpu"] if took["gpu"] else math.nan, "")


def main(device: str, kernel: str) -> None:
    """Print the verdict of a kernel as JSON."""
    with redirect_stdout(sys.stderr):
        verdict = examined(import_module(f"{kernel}.cases").cases(), device)
    print(json.dumps(verdict))


if __name__ == "__main__":
    main(*sys.argv[1:])
