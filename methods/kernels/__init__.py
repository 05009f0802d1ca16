"""Operations of radiance-field rendering, each with a plain-torch reference and fast backends.

A kernel is a folder: `__init__` has its signature and documentation, `reference` the plain-torch
version (any dtype, any device, differentiable; the others are compared with it), `cpu` the numba
version, `gpu` the Triton version. All backends of a kernel have the same signature. Wrong shapes
raise ValueError, as do with backend="cpu" numbers other than float32, unless a kernel says more.
"""

from methods.kernels.dispatch import BACKENDS, availability, compiled, multiplies_bf16, resolve

__all__ = ["BACKENDS", "availability", "compiled", "multiplies_bf16", "resolve"]
