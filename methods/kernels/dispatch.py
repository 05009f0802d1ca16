"""Which backend serves a call: by name or by the device of the tensors, never a silent fallback but
for what `gpu` has no kernel for, which torch computes on the device."""

from __future__ import annotations

import difflib
import importlib
import importlib.util
import os
from functools import cache
from pathlib import Path
from types import ModuleType

import torch

from bench.errors import Unavailable

BACKENDS = ("reference", "cpu", "gpu")


@cache
def availability() -> dict[str, str]:
    """For each backend, "" where it can be used here, else why not and how to get it."""
    reasons = dict.fromkeys(BACKENDS, "")
    if importlib.util.find_spec("numba") is None:
        reasons["cpu"] = "numba is not installed: pip install numba"
    if importlib.util.find_spec("triton") is None:
        reasons["gpu"] = "Triton is not installed; it comes with torch for CUDA"
    elif not (torch.cuda.is_available() or interpreted()):
        reasons["gpu"] = "torch sees no GPU"
    return reasons


def interpreted() -> bool:
    """Whether Triton's interpreter, in place of its compiler, runs the kernels of `gpu`: on CPU
    tensors, and slowly. For tests where there is no GPU."""
    return os.environ.get("TRITON_INTERPRET") == "1"


def resolve(backend: str, device: torch.device | str) -> str:
    """The name of the backend that will serve tensors on `device`.

    `auto` goes by the device alone: CPU tensors to `cpu`, all others to `reference`. The kernels of
    `gpu` were never run on one: they serve who asks for them by name.

    Raises:
        Unavailable: the backend asked for by name is unknown, cannot be used here, or does not
            serve this device.
    """
    kind = torch.device(device).type
    if backend == "auto":
        return "cpu" if kind == "cpu" else "reference"
    if backend not in BACKENDS:
        near = difflib.get_close_matches(backend, BACKENDS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise Unavailable(
            f"backend={backend!r}: expected auto or one of {', '.join(BACKENDS)}{hint}"
        )
    if reason := availability()[backend]:
        raise Unavailable(f"backend={backend!r} cannot be used here: {reason}")
    if backend == "cpu" and kind != "cpu":
        raise Unavailable(
            f"backend='cpu' serves CPU tensors, these are on {kind!r}: "
            "use backend=auto or device=cpu"
        )
    if backend == "gpu" and kind != "cuda" and not interpreted():
        raise Unavailable(
            f"backend='gpu' serves CUDA tensors, these are on {kind!r}: "
            "use backend=auto or device=cuda"
        )
    return backend


@cache
def multiplies_bf16(kind: str) -> bool:
    """Whether devices of this kind ("cpu", "cuda") here have products of bfloat16.

    A CPU without them, any x86 with AVX2 alone, takes ten times as long as for those of float32.
    """
    if kind == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    instructions = torch.cpu.get_capabilities()
    return any(instructions.get(name) for name in ("avx512_bf16", "amx_bf16", "bf16"))


def implementation(kernel: str, backend: str, device: torch.device) -> ModuleType:
    """The module that implements `kernel` (a folder beside this file) for tensors on `device`.

    With backend="gpu" torch computes, on the device, what has no kernel in Triton.
    """
    name = resolve(backend, device)
    if name == "gpu" and not has(kernel, name):
        name = "reference"
    if name == "cpu":
        _load("methods.kernels.cpu").follow_torch_threads()
    return _load(f"methods.kernels.{kernel}.{name}")


def serves_many_threads(backend: str, device: torch.device) -> bool:
    """Whether several threads may call kernels of `backend` at once."""
    if resolve(backend, device) != "cpu":
        return True
    return bool(_load("methods.kernels.cpu").serves_many_threads())


def has(kernel: str, backend: str) -> bool:
    """Whether `backend` has an implementation of its own of `kernel`."""
    return (Path(__file__).parent / kernel / f"{backend}.py").exists()


# Imported when first used: numba and Triton are heavy, and not every machine has both.
_load = cache(importlib.import_module)
