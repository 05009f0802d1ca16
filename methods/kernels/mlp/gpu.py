"""A small network on a GPU, layer by layer with torch."""

from __future__ import annotations

from methods.kernels.mlp.reference import mlp

__all__ = ["mlp"]
