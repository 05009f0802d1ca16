"""Compile every kernel of the GPU for a Hopper chip, which needs none: with the arguments that the
cases of the kernels give, one line each; with the last of them also for Ampere and Ada. Run by
test_gpu.py as a program of its own, in which nothing is interpreted.
"""

import importlib
import os
from contextlib import suppress
from typing import Any

import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

import methods.kernels.gpu
from bench.case import Difference
from methods.checks import found
from methods.kernels.dispatch import kernels

AMPERE, ADA, HOPPER = (GPUTarget("cuda", capability, 32) for capability in (80, 89, 90))
TYPES = {
    f"torch.{kind}{bits}": f"{short}{bits}"
    for kind, short in (("float", "fp"), ("int", "i"), ("uint", "u"))
    for bits in (8, 16, 32, 64)
} | {"torch.bfloat16": "bf16"}


def signature(value: Any) -> str:
    """The type of an argument, as Triton writes it, which takes a 1 for a constant."""
    if isinstance(value, Tensor):
        return f"*{TYPES[str(value.dtype)]}"
    if value == 1:
        return "constexpr"
    return {float: "fp32", int: "i32"}.get(type(value), "constexpr")


def aligned(value: Any) -> bool:
    """Whether Triton compiles for a multiple of 16: of bytes, or the number itself."""
    return isinstance(value, Tensor) or (isinstance(value, int) and value % 16 == 0)


def compile_for_hopper(
    kernel: triton.JITFunction, grid: tuple[int, ...], *arguments: Any, **options: Any
) -> None:
    """In place of `methods.kernels.gpu.launch`."""
    given = dict(zip(kernel.arg_names, arguments, strict=False))
    constants = {name: value for name, value in options.items() if name in kernel.arg_names}
    constants |= {name: value for name, value in given.items() if signature(value) == "constexpr"}
    types = {
        name: "constexpr" if name in constants else signature(given[name])
        for name in kernel.arg_names
    }
    multiples = {
        (index,): [["tt.divisibility", 16]]
        for index, name in enumerate(kernel.arg_names)
        if name not in constants and aligned(given[name])
    }
    line = f"{kernel.fn.__module__}.{kernel.fn.__name__} {types} {constants} {multiples}"
    if line not in seen:
        seen.add(line)
        rest = {name: value for name, value in options.items() if name not in constants}
        last[kernel] = ASTSource(kernel, types, constants, multiples), rest
        compile_for(HOPPER, *last[kernel])
        print(kernel.fn.__module__, kernel.fn.__name__)


def compile_for(target: GPUTarget, source: ASTSource, options: dict[str, Any]) -> None:
    """As `methods.kernels.gpu.launch` compiles."""
    triton.compile(source, target=target, options={"enable_fp_fusion": False, **options})


seen: set[str] = set()
last: dict[triton.JITFunction, tuple[ASTSource, dict[str, Any]]] = {}
methods.kernels.gpu.launch = compile_for_hopper
for kernel in kernels("gpu"):
    importlib.import_module(f"{kernel}.gpu")
os.environ["TRITON_INTERPRET"] = "1"  # so that CPU tensors are taken; too late for a kernel
for case in found("cases"):
    by_gpu = any(backend == "gpu" for backend, _ in case.tolerances)
    if isinstance(case.error, Difference) and by_gpu and not case.timed:
        with suppress(IndexError):  # no kernel has written the indices that torch reads
            case.error.prepare("cpu")("gpu")
for given in last.values():
    for target in (AMPERE, ADA):
        compile_for(target, *given)
