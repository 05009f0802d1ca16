"""Cases of the compositing."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from methods.kernels.case import U32, Case, Prepared
from methods.kernels.composite import Pixels, composite, visible_counts, weights

DEPTH = 2.0
"""Largest t of the samples: the size of what is summed, values being at most 1."""


def cases() -> list[Case]:
    """Rays without samples, with one and with 1024; thin, opaque, stopped, continued; K up to 9."""
    kinds: list[tuple[str, int, int, dict]] = [
        ("no ray", 0, 0, {}),
        ("rays without samples", 5, 0, {}),
        ("one sample a ray", 7, 1, {}),
        ("1024 samples a ray", 3, 1024, {}),
        ("ragged rays", 101, 37, {}),
        ("nine channels", 33, 20, {"channels": 9}),
        ("no density", 9, 12, {"density": 0.0}),
        ("opaque at once", 9, 12, {"density": 1e30}),
        ("continued", 33, 20, {"carry": True}),
        ("a background a ray", 33, 20, {"background": True}),
        # Only a transmittance within rounding of `stop` could end a ray one sample earlier.
        ("stopped after many samples", 20, 200, {"stop": 0.3}),
    ]
    found = [
        Case(f"composite{direction}", name, "fp32", rays * most, partial(make, rays, most, options))
        for name, rays, most, options in kinds
        for direction, make in (
            ("", _forward),
            (" backward", _backward),
            (" weights", _weights),
            (" visible", _visible),
        )
    ]
    return [
        *found,
        Case(
            "composite",
            "64 samples a ray",
            "fp32",
            1 << 18,
            partial(_forward, 1 << 12, 64, {}),
            True,
        ),
        Case(
            "composite backward",
            "64 samples a ray",
            "fp32",
            1 << 18,
            partial(_backward, 1 << 12, 64, {}),
            True,
        ),
    ]


def _inputs(rays: int, most: int, options: dict, device: str) -> tuple[dict, Tensor]:
    generator = torch.Generator().manual_seed(rays + most)
    counts = torch.randint(0, most + 1, (rays,), generator=generator)
    if options == {}:
        counts[: len(counts) // 2] = most  # the longest rays are there
    offsets = torch.cat((torch.zeros(1, dtype=torch.int64), counts.cumsum(0)))
    total, channels = int(offsets[-1]), options.get("channels", 3)
    inputs = {
        "sigma": options.get("density", 2.0) * torch.rand(total, generator=generator),
        "values": torch.rand(total, channels, generator=generator),
        "t": DEPTH * torch.rand(total, generator=generator),
        "delta": 2.0 / max(most, 1) * torch.rand(total, generator=generator),
        "offsets": offsets,
    }
    inputs = {name: tensor.to(device) for name, tensor in inputs.items()}
    inputs["sigma"].requires_grad_()
    inputs["values"].requires_grad_()
    if options.get("background"):
        inputs["background"] = torch.rand(rays, channels, generator=generator).to(device)
    if options.get("carry"):
        alpha = torch.rand(rays, generator=generator).to(device)
        inputs["carry"] = Pixels(alpha[:, None].expand(rays, channels), DEPTH * alpha, alpha)
    return inputs, torch.rand(rays, channels + 2, generator=generator).to(device)


def _tolerance(most: int) -> float:
    """Of a sum of n weighted values.

    Transmittance, a product of n rounded exponentials or the exponential of a rounded sum, is off
    by n u relative to itself in each backend; weights add up to 1 at most, and so do their errors,
    of size DEPTH; adding them up is off by n u once more.
    """
    return 4 * (most + 8) * U32 * DEPTH


def _forward(rays: int, most: int, options: dict, device: str) -> Prepared:
    inputs, _ = _inputs(rays, most, options, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        with torch.no_grad():
            pixels = composite(**inputs, stop=options.get("stop", 0.0), backend=backend)
        return pixels.values, pixels.depth_sum, pixels.alpha

    return Prepared(call, _tolerance(most))


def _backward(rays: int, most: int, options: dict, device: str) -> Prepared:
    inputs, grad = _inputs(rays, most, options, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        pixels = composite(**inputs, stop=options.get("stop", 0.0), backend=backend)
        outputs = torch.cat(
            (pixels.values, pixels.depth_sum[:, None], pixels.alpha[:, None]), dim=1
        )
        return torch.autograd.grad(outputs, [inputs["sigma"], inputs["values"]], grad)

    # The gain of a weight is a product with K + 2 gradients of at most 1; delta is at most 2 / n.
    channels = grad.shape[1]
    return Prepared(call, channels * _tolerance(most))


def _weights(rays: int, most: int, options: dict, device: str) -> Prepared:
    inputs, _ = _inputs(rays, most, options, device)
    samples = (inputs["sigma"], inputs["delta"], inputs["offsets"])
    front = 1 - inputs["carry"].alpha if "carry" in inputs else None

    def call(backend: str) -> tuple[Tensor, ...]:
        stop = options.get("stop", 0.0)
        return (weights(*samples, stop=stop, front=front, backend=backend),)

    return Prepared(call, _tolerance(most))


def _visible(rays: int, most: int, options: dict, device: str) -> Prepared:
    inputs, _ = _inputs(rays, most, options, device)

    def call(backend: str) -> tuple[Tensor, ...]:
        return (
            visible_counts(
                inputs["sigma"], inputs["delta"], inputs["offsets"], stop=0.3, backend=backend
            ),
        )

    # Only a transmittance within rounding of the threshold, 1e-6 of those there may be, could end a
    # ray one sample earlier.
    return Prepared(call, 0.0)
