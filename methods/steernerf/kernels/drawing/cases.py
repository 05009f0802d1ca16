"""Cases of the two ends of the 2D renderer's network: agreement of the backends."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from bench.case import U32, Bound, Case, Given, Operation
from methods.kernels.dispatch import served
from methods.steernerf.kernels.drawing import corrected, shown

LOW, SCALE = 200, 4  # of the timed cases: the sides of a low-resolution frame, and s


def _shown(given: Given, backend: str) -> tuple[Tensor, ...]:
    parts = given["present"], given["values"], given["index"]
    return (shown(*parts, given["frames"], dtype=given["dtype"], backend=backend),)


def _corrected(given: Given, backend: str) -> tuple[Tensor, ...]:
    parts = given["rgb"], given["correction"], (3, 1), given["scale"], given["aligned"]
    return (corrected(*parts, clip=given["clip"], backend=backend),)


def _sums(given: Given) -> Tensor:
    """2 n (n - 1) u for each row, which n pixels show."""
    index = given["index"].flatten()
    times = torch.bincount(index[index >= 0], minlength=len(given["values"]))
    return (2 * times * (times - 1).clamp(min=0) * U32)[:, None]


def _places(given: Given) -> float:
    """A place between two pixels of n is off by 2 n u, and so is a share of it: of numbers from -1
    to 1, two of them to mix, twice; and three roundings of at most 2."""
    return (2 * 2 * 2 * max(given["rgb"].shape[:2]) + 2 * 3) * 2 * U32


def _reduced(given: Given) -> float:
    """Of 4 s^2 or fewer pixels, each off as above, and sums of as many."""
    count = 4 * given["scale"] ** 2
    return count * _places(given) + 2 * count * (count - 1) * U32


EXACT = Bound("numbers are moved, nothing is computed: 0", 0.0)
SUMS = Bound("n pixels: n - 1 sums of at most n, off by n u in each backend: 2 n (n - 1) u", _sums)
PLACED = Bound("places of n pixels are off by 2 n u, twice; three roundings of at most 2", _places)
REDUCED = Bound("4 s^2 pixels, each off as an enlarged one, and their sum", _reduced)
BY = served(__package__)
SHOWN = Operation("network input", BY, _shown, {"input": EXACT}, {"present": EXACT, "values": SUMS})
HALVES = Operation("network input", BY, _shown, {"input": EXACT})
CORRECTED = Operation(
    "picture", BY, _corrected, {"picture": PLACED}, {"rgb": REDUCED, "correction": EXACT}
)
CLIPPED = Operation("picture", BY, _corrected, {"picture": PLACED})


def cases() -> list[Case]:
    """Inputs and pictures by all backends; those of 800 x 800 are timed."""
    found = []
    sizes = ((5, 7, 6, 2, 4, 2), (3, 4, 3, 0, 4, 0), (4, 2, 8, 3, 2, 1), (1, 1, 4, 1, 3, 1))
    for height, width, channels, frames, scale, present in sizes:
        given = partial(_frames, height, width, channels, frames, scale, present)
        name = f"{height} x {width}, K = {channels}, L = {frames}, s = {scale}"
        found += SHOWN.cases(name, given)
        found += HALVES.cases(f"{name}, bfloat16", partial(given, dtype=torch.bfloat16))
    for height, width, scale, aligned in ((5, 7, 4, 1), (5, 7, 4, 0), (1, 3, 3, 0), (2, 1, 1, 1)):
        given = partial(_colours, height, width, scale, bool(aligned))
        name = f"{height} x {width}, s = {scale}, {'places' if aligned else 'corners'} kept"
        found += CORRECTED.cases(name, given)
        found += CLIPPED.cases(f"{name}, clipped", partial(given, clip=True))
    side = f"{LOW} x {LOW} to {LOW * SCALE} x {LOW * SCALE}"
    frame = partial(_frames, LOW, LOW, 6, 2, SCALE, 2)
    found += SHOWN.cases(side, frame, items=(SCALE * LOW) ** 2)
    return found + CORRECTED.cases(
        side, partial(_colours, LOW, LOW, SCALE, True), items=(SCALE * LOW) ** 2
    )


def _frames(
    height: int,
    width: int,
    channels: int,
    frames: int,
    scale: int,
    preceding: int,
    dtype: torch.dtype | None = None,
) -> Given:
    """A frame and points of `preceding` ones, which a sixteenth of the pixels show."""
    generator = torch.Generator().manual_seed(height + width)
    each, points = height * width, max(height * width * preceding, 1)
    shape = preceding, height * scale, width * scale
    index = torch.randint(0, each, shape, generator=generator, dtype=torch.int32)
    index += each * torch.arange(preceding, dtype=torch.int32)[:, None, None]  # of each frame
    seen = torch.rand(shape, generator=generator) < 1 / 16
    return {
        "present": torch.rand(height, width, channels, generator=generator),
        "values": torch.rand(points, channels, generator=generator),
        "index": torch.where(seen, index, -1),
        "frames": frames,
        "dtype": dtype,
    }


def _colours(height: int, width: int, scale: int, aligned: bool, clip: bool = False) -> Given:
    """Colours, and a correction of all pixels from (3, 1) on, that leaves [0, 1] at times."""
    generator = torch.Generator().manual_seed(height + width)
    sides = max(height * scale - 3, 0), max(width * scale - 1, 0)
    return {
        "rgb": torch.rand(height, width, 3, generator=generator),
        "correction": torch.rand(*sides, 3, generator=generator) - 0.5,
        "scale": scale,
        "aligned": aligned,
        "clip": clip,
    }
