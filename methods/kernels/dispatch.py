"""Selects the backend of a kernel, by name or by the device of the tensors."""

import difflib
import importlib
import importlib.util
import os
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

from bench.errors import Unavailable
from bench.provenance import sources

BACKENDS = ("reference", "cpu", "gpu")


@cache
def availability() -> dict[str, str]:
    """For each backend, "" if it can be used here, otherwise why not and how to get it."""
    reasons = dict.fromkeys(BACKENDS, "")
    if importlib.util.find_spec("triton") is None:
        reasons["gpu"] = "Triton is not installed; it comes with torch for CUDA"
    elif not (torch.cuda.is_available() or interpreted()):
        reasons["gpu"] = "torch sees no GPU"
    return reasons


def interpreted() -> bool:
    """Whether Triton interprets the kernels of `gpu` on CPU tensors, slowly, for tests."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def resolve(backend: str, device: torch.device | str) -> str:
    """The name of the backend that computes on `device`.

    `auto` is `cpu` for CPU tensors. For those of a GPU with Triton it stays `auto`: each kernel has
    the backend that its trial there chose, see `implementation`. For others it is `reference`.

    Raises `Unavailable` if the named backend is unknown, cannot be used here, or does not compute
    on this device.
    """
    kind = torch.device(device).type
    if backend == "auto":
        if kind == "cpu":
            return "cpu"
        return "reference" if availability()["gpu"] or interpreted() else "auto"
    if backend not in BACKENDS:
        near = difflib.get_close_matches(backend, BACKENDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise Unavailable(
            f"backend={backend!r}: expected auto or one of {', '.join(BACKENDS)}{hint}"
        )
    if reason := availability()[backend]:
        raise Unavailable(f"backend={backend!r} cannot be used here: {reason}")
    device = {"cpu": "cpu", "gpu": kind if interpreted() else "cuda"}.get(backend, kind)
    if kind != device:
        raise Unavailable(
            f"backend={backend!r} serves {device.upper()} tensors, these are on {kind!r}: "
            f"use backend=auto or device={device}"
        )
    return backend


def by_kernel(backend: str, method: Any, device: torch.device) -> str:
    """What computes the kernels that `method`, a class or function, imports, directly or not, if
    `backend` is asked for: the reference has those that lack such a version. For rows."""
    folders = [Path(name).parent for name in sources(method) if name.endswith("/reference.py")]
    found = {x.name: _computing(".".join(x.parts), backend, device) for x in folders}
    slow = sorted(kernel for kernel, name in found.items() if name == "reference")
    fast = next((name for name in found.values() if name != "reference"), "")
    if not fast or not slow:
        return fast or "reference"
    return f"{fast}, but reference: {', '.join(slow)}"


@cache
def multiplies_bf16(kind: str) -> bool:
    """Whether devices of this kind ("cpu", "cuda") here have products of bfloat16. A CPU without
    them, such as an x86 with only AVX2, needs ten times as long as for float32."""
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    instructions = torch.cpu.get_capabilities()
    return any(instructions.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def implementation(kernel: str, backend: str, device: torch.device) -> ModuleType:
    """The module that implements `kernel`, a package, for tensors on `device`. The reference
    computes a kernel that has no such version; see `by_kernel`. Raises `Unavailable` as `resolve`
    does."""
    name = _computing(kernel, resolve(backend, device), device)
    if name == "cpu":
        _load("methods.kernels.cpu").follow_torch_threads()
    return _load(f"{kernel}.{name}")


def _computing(kernel: str, backend: str, device: torch.device) -> str:
    """The backend that computes `kernel` if `backend` is asked for."""
    if backend == "auto":
        verdict = _load("methods.trial").verdicts(str(device)).get(kernel)
        return "gpu" if verdict and verdict.trusted else "reference"
    return backend if backend in served(kernel) else "reference"


@cache
def served(kernel: str) -> Sequence[str]:
    """The backends that implement `kernel`, a package."""
    folder = Path(*importlib.import_module(kernel).__path__)
    return tuple(name for name in BACKENDS if (folder / f"{name}.py").exists())


def compiled(device: str) -> list[str]:
    """The backends that run on `device` here at full speed, which excludes an interpreted one."""
    usable = []
    for name in BACKENDS:
        with suppress(Unavailable):
            usable.append(resolve(name, device))
    return [name for name in usable if not (name == "gpu" and interpreted())]


# Imported on first use, because numba and Triton are heavy and not every machine has the latter.
_load = cache(importlib.import_module)
