"""Compile every kernel of the GPU for three generations of chips, without any: with all
arguments that the cases give, one line each. Run by test_gpu.py as a program of its own, in which
nothing is interpreted.
"""

import importlib
import os
from contextlib import suppress
from typing import Any

import torch
import triton
from torch import Tensor
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

import methods.kernels.gpu
from bench.case import Difference
from methods.checks import found, kernels

TARGETS = [GPUTarget("cuda", capability, 32) for capability in (80, 90, 120)]
TYPES = {
    f"torch.{kind}{bits}": f"{short}{bits}"
    for kind, short in (("float", "fp"), ("int", "i"), ("uint", "u"))
    for bits in (8, 16, 32, 64)
} | {"torch.bfloat16": "bf16"}


def signature(value: Any) -> str:
    """The type of an argument, as Triton writes it, which takes a whole 1 for a constant."""
    if isinstance(value, Tensor):
        return f"*{TYPES[str(value.dtype)]}"
    if type(value) is int and value == 1:
        return "constexpr"
    return {float: "fp32", int: "i32"}.get(type(value), "constexpr")


def aligned(value: Any) -> bool:
    """Whether Triton compiles for a multiple of 16: of bytes, or the number itself."""
    if isinstance(value, Tensor):
        return value.data_ptr() % 16 == 0
    return isinstance(value, int) and value % 16 == 0


def compile_for_all(
    kernel: triton.JITFunction, grid: tuple[int, ...], *arguments: Any, **options: Any
) -> None:
    """In place of `methods.kernels.gpu.launch`, and with its options."""
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
        source = ASTSource(kernel, types, constants, multiples)
        for target in TARGETS:
            triton.compile(source, target=target, options={"enable_fp_fusion": False, **rest})
        print(kernel.fn.__module__, kernel.fn.__name__)


seen: set[str] = set()
# What no kernel has written is read as a number of samples.
torch.empty, torch.empty_like, Tensor.new_empty = torch.zeros, torch.zeros_like, Tensor.new_zeros
methods.kernels.gpu.launch = compile_for_all
for kernel in kernels("gpu"):
    importlib.import_module(f"{kernel}.gpu")
os.environ["TRITON_INTERPRET"] = "1"  # so that CPU tensors are taken; too late for a kernel
for case in found("cases"):
    by_gpu = any(backend == "gpu" for backend, _ in case.tolerances)
    if isinstance(case.error, Difference) and by_gpu and not case.timed:
        with suppress(IndexError):  # no kernel has written the indices that torch reads
            case.error.prepare("cpu")("gpu")
