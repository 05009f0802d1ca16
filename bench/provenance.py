"""Where a row comes from: the commit and the machine that made it."""

from __future__ import annotations

import functools
import os
import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from bench.sources import ROOT, digest, libraries

CPU_MARKS = ("cpu family", "model", "CPU implementer", "CPU part")
"""Fields of /proc/cpuinfo that tell apart processors which share a name but compute differently."""


@functools.cache
def commit() -> str:
    """The commit of a git checkout, with `-dirty` if changed; otherwise the installed version."""
    try:
        # An installed copy may lie inside a repository that has nothing to do with it.
        _git("ls-files", "--error-unmatch", __file__)
        return _git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return metadata.version("steerbench")


def machine() -> dict[str, object]:
    """The machine and its system, for the record of a run."""
    import torch  # imported here, because reading the store needs no torch

    capabilities = torch.cpu.get_capabilities()
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_bytes": os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        "gpus": [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())],
        "cuda": torch.version.cuda,
        "system": platform.platform(),
        "python": platform.python_version(),
        "instructions": sorted(name for name, has in capabilities.items() if has is True),
    }


def computed_by(*things: Any) -> dict[str, object]:
    """What decides the results of `things` (classes or functions) beside their inputs, for keys."""
    import torch

    record = machine()
    return {
        "code": digest(*things),
        "libraries": libraries(*things),
        "machine": {name: record[name] for name in ("cpu", "instructions", "gpus", "python")},
        "threads": torch.get_num_threads(),
        "kernel_threads": os.environ.get("NUMBA_NUM_THREADS", ""),  # upper limit
    }


def _git(*arguments: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def _cpu_model() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    # The first processor stands for all of them.
    known = {k.strip(): v.strip() for k, _, v in (x.partition(":") for x in text.splitlines()[:40])}
    marks = [f"{mark.removeprefix('cpu ')} {known[mark]}" for mark in CPU_MARKS if mark in known]
    name = known.get("model name", platform.machine())
    return f"{name} ({', '.join(marks)})" if marks else name
