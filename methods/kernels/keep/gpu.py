"""Choosing samples on a GPU with torch, in a few passes over all of them."""

from __future__ import annotations

from methods.kernels.keep.reference import keep

__all__ = ["keep"]
