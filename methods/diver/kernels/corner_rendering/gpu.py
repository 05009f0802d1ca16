"""Pixels of corner features on a GPU: Triton kernels of the steps, matrix products by torch."""

from __future__ import annotations

from functools import partial

from methods.diver.kernels.corner_rendering.reference import by_steps

render_segments = partial(by_steps, "gpu")
"""See `methods.diver.kernels.corner_rendering.render_segments`."""
