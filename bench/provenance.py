"""Where a row comes from: the code, the commit and the machine that made it."""

from __future__ import annotations

import functools
import hashlib
import os
import platform
import subprocess
import sys
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
MEASURING_PACKAGES = ("bench", "methods")
VERSIONS_OF = ("torch", "numpy", "numba", "kornia", "scikit-image", "lpips")
VERSIONS_OF_ENGINES = ("openvino", "nncf", "onnx", "onnxruntime", "tensorrt")
"""Extras: they compute frames, and have no part in a training."""

CPU_MARKS = ("cpu family", "model", "CPU implementer", "CPU part")
"""Of /proc/cpuinfo: names alone are shared by processors that compute differently."""


@functools.cache
def code_digest() -> str:
    """SHA-256 of what can change a row: paths and bytes of all sources and weights of bench and
    methods."""
    return digest(
        path
        for name in MEASURING_PACKAGES
        for kind in ("*.py", "*.safetensors")
        for path in (ROOT / name).rglob(kind)
    )


def digest(sources: Iterable[Path]) -> str:
    """SHA-256 of the paths and bytes of source files of this project, whatever their order."""
    total = hashlib.sha256()
    for path in sorted(sources):
        content = path.read_bytes()
        total.update(f"{path.relative_to(ROOT).as_posix()} {len(content)}\n".encode())
        total.update(content)
    return total.hexdigest()


def foreign_digest(thing: Any) -> str | None:
    """SHA-256 of the file that `thing` is defined in; None if `code_digest` covers it."""
    module = sys.modules[thing.__module__]
    path = Path(getattr(module, "__file__", None) or __file__).resolve()  # none: built in
    if any(path.is_relative_to(ROOT / name) for name in MEASURING_PACKAGES):
        return None
    return hashlib.sha256(path.read_bytes()).hexdigest()


@functools.cache
def commit() -> str:
    """The commit of a git checkout, with `-dirty` after changes; else the installed version."""
    try:
        # An installed copy may lie inside a repository that has nothing to do with it.
        _git("ls-files", "--error-unmatch", __file__)
        return _git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return metadata.version("steerbench")


def machine() -> dict[str, object]:
    """The machine and the versions of what it runs, for the record of a run."""
    import torch  # here, because reading the store needs no torch

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
        "versions": {name: metadata.version(name) for name in VERSIONS_OF},
        "engines": {name: version for name in VERSIONS_OF_ENGINES if (version := _version(name))},
    }


def decisive(*, engines: bool) -> dict[str, object]:
    """What of the machine decides on a training, and with `engines` on figures: those of others are
    other ones."""
    names = ("cpu", "instructions", "gpus", "versions", *(("engines",) if engines else ()))
    found = machine()
    return {name: found[name] for name in names}


def _version(library: str) -> str | None:
    try:
        return metadata.version(library)
    except metadata.PackageNotFoundError:
        return None


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
    # Of the first processor; the others are taken to be like it.
    known = {k.strip(): v.strip() for k, _, v in (x.partition(":") for x in text.splitlines()[:40])}
    marks = [f"{mark.removeprefix('cpu ')} {known[mark]}" for mark in CPU_MARKS if mark in known]
    name = known.get("model name", platform.machine())
    return f"{name} ({', '.join(marks)})" if marks else name
