"""Cases of the convolution: widths and sides of any number, two parts, all that can follow it.

Most have short whole numbers, of which the fast algorithm rounds none: weights are multiples of
24^2, so that G g G^T is whole, and no sum of absolute values exceeds 2^24.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional

from bench.case import U32, Bound, Case, Given, Operation, uniform
from methods.kernels.dispatch import served
from methods.steernerf.kernels.convolution import convolution, halved
from methods.steernerf.kernels.spans import Spans

# B^T, 24 G and A^T of Lavin & Gray 2016, Section 4.3, without signs.
B_T = torch.tensor(
    [
        [4, 0, 5, 0, 1, 0],
        [0, 4, 4, 1, 1, 0],
        [0, 4, 4, 1, 1, 0],
        [0, 2, 1, 2, 1, 0],
        [0, 2, 1, 2, 1, 0],
        [0, 4, 0, 5, 0, 1],
    ],
    dtype=torch.float64,
)
G24 = torch.tensor(
    [[6, 0, 0], [4, 4, 4], [4, 4, 4], [1, 2, 4], [1, 2, 4], [0, 0, 24]], dtype=torch.float64
)
A_T = torch.tensor(
    [[1, 1, 1, 1, 1, 0], [0, 1, 1, 2, 2, 0], [0, 1, 1, 4, 4, 0], [0, 1, 1, 8, 8, 1]],
    dtype=torch.float64,
)

# Of 30 x 50 pixels: to both sides, none, all, past the end.
SPANS = Spans(torch.tensor([[1, 4], [3, 3], [0, 7], [5, 9]]), 8)

FRAME, PATCH = (1, 800, 704), (1, 300, 300)  # of the U-Net, drawn and trained
CHANNELS = 16


def _tiles(pictures: Tensor) -> Tensor:
    """|B^T| |d| |B| of all tiles, [B, C, down, across, 6, 6]."""
    height, width = pictures.shape[2:]
    around = functional.pad(pictures.double().abs(), (1, 1 + -width % 4, 1, 1 + -height % 4))
    return B_T @ around.unfold(2, 6, 4).unfold(3, 6, 4) @ B_T.T


def _sums(pictures: Tensor, weight: Tensor) -> Tensor:
    """The sums of a convolution where all numbers on the way are positive and nothing cancels:
    S = |A^T| [(|G| |g| |G^T|) . (|B^T| |d| |B|)] |A|, [B, O, H, W]."""
    height, width = pictures.shape[2:]
    weight = G24 @ weight.double().abs() @ G24.T / 24**2
    squares = A_T @ torch.einsum("oiab,niyxab->noyxab", weight, _tiles(pictures)) @ A_T.T
    return squares.transpose(3, 4).flatten(4, 5).flatten(2, 3)[..., :height, :width]


def _largest(given: Given) -> Tensor:
    """The same of all parts, and what is added."""
    total = _sums(torch.cat(list(given["parts"]), dim=1), given["weight"])
    total = total + given["bias"].double().abs()[:, None, None]
    return total + given["plus"].abs() if "plus" in given else total


def _off(given: Given) -> Tensor:
    """Numbers are rounded once in the weights, 2 x 3 times in B^T d B, once a channel in the sum, 2
    x 4 times in A^T m A, and twice where something is added; the reference rounds 9 times a
    channel."""
    channels = given["weight"].shape[1]
    return (10 * channels + 17) * U32 * _largest(given)


def _parts_off(given: Given) -> float:
    """As above; the gradient of the parts is a convolution of that of the result, here at most 1,
    over the channels of which it sums."""
    outputs, (batch, _, *size) = len(given["weight"]), given["parts"][0].shape
    back = given["weight"].transpose(0, 1).flip(2, 3)
    largest = _sums(torch.ones(batch, outputs, *size), back).max().item()
    return (10 * outputs + 17) * U32 * largest


def _weight_off(given: Given) -> Tensor:
    """S = |G^T| [sum of (|A| |Y| |A^T|) . (|B^T| |d| |B|)] |G| over all tiles, with Y at most 1.
    Numbers are rounded 2 x 3 times in B^T d B and in A Y A^T, at most twice for each tile in their
    sum, and less than 12 times after it; those of the reference twice for each pixel."""
    tiles = _tiles(torch.cat(list(given["parts"]), dim=1))
    most = A_T.sum(0)  # |A| 1
    sums = torch.einsum("niyxab,a,b->iab", tiles, most, most)
    count = given["parts"][0][:, 0].numel()
    return (4 * count + 24) * U32 * (G24.T @ sums @ G24 / 24**2)


def _bias_off(given: Given) -> float:
    """n numbers of at most 1, in any order: n u n in each backend."""
    count = given["parts"][0][:, 0].numel()
    return 2 * U32 * count**2


def _signs(generator: torch.Generator, shape: Sequence[int], share: float = 0.05) -> Tensor:
    """-1 or 1 in a `share` of the places, 0 in the others."""
    signs = 2.0 * torch.randint(0, 2, tuple(shape), generator=generator) - 1
    return signs * (torch.rand(tuple(shape), generator=generator) < share)


def _convolved(given: Given, backend: str) -> tuple[Tensor, ...]:
    """The result, 0 where it is undefined."""
    out, spans = convolution(**given, backend=backend), given.get("spans")
    if spans is None:
        return (out,)
    times = 2 if given.get("shuffle") else 1
    enlarged = replace(spans, unit=times * spans.unit)
    return (torch.where(enlarged.mask(*out.shape[2:]), out, 0),)


EXACT = Bound("short numbers: 0", 0.0)
SHORT = Operation("convolution", served(__package__), _convolved, {"sums": EXACT}, draw=_signs)
LONG = Operation(
    "convolution", served(__package__), _convolved, {"sums": Bound("(10 C + 17) u S", _off)}
)
LEARNED = replace(
    LONG,
    gradients={
        "parts": Bound("(10 O + 17) u S", _parts_off),
        "weight": Bound("n pixels: (4 n + 24) u S", _weight_off),
        "bias": Bound("n pixels: 2 n^2 u", _bias_off),
    },
)
HALVED = Operation(
    "halved",
    served(__package__),
    lambda given, backend: (halved(given["pictures"], backend=backend),),
    {"maxima": EXACT},
)


def cases() -> list[Case]:
    """One pixel, sides of all remainders, few and many channels; a frame of the U-Net, timed."""
    kinds: dict[str, tuple[Sequence[int], Sequence[int], int, dict[str, bool]]] = {
        "one pixel": ((1, 1, 1), (16,), 16, {}),
        "a tile": ((1, 4, 4), (16,), 16, {}),
        "5 x 7, few channels": ((1, 5, 7), (3,), 5, {"relu": True}),
        "two parts, a sum": ((2, 9, 10), (32, 18), 16, {"relu": True, "plus": True}),
        "two parts of few channels": ((1, 6, 203), (2, 17), 3, {}),
        "shuffled": ((2, 8, 11), (16,), 64, {"shuffle": True, "relu": True}),
        "few shuffled": ((1, 7, 6), (4,), 12, {"shuffle": True}),
        "spans": ((2, 30, 50), (16,), 16, {"spans": True, "plus": True}),
        "spans, shuffled": ((1, 30, 50), (2, 16), 64, {"spans": True, "shuffle": True}),
    }
    found = []
    for name, kind in kinds.items():
        how = kind[-1]
        learned = ["parts", "weight", "bias", *(["plus"] if "plus" in how else [])]
        learns = replace(SHORT, gradients=dict.fromkeys(learned, EXACT))
        found += (SHORT if "spans" in how else learns).cases(name, partial(_short, *kind))
    found += LONG.cases("long numbers, ReLU", partial(_long, (1, 30, 30), relu=True))
    found += LEARNED.cases("long numbers", partial(_long, (1, 30, 30)))
    frame, patch = (partial(_long, size) for size in (FRAME, PATCH))
    found += LONG.cases("a frame, 16 channels", partial(frame, relu=True), items=800 * 704)
    found += LEARNED.cases("a patch, 16 channels", patch, items=300 * 300)
    pictures: dict[str, tuple[Sequence[int], int | None]] = {
        "2 x 2": ((1, 3, 2, 2), None),
        "several": ((2, 16, 6, 10), None),
        "a frame, 16 channels": ((1, CHANNELS, *FRAME[1:]), 800 * 704),
    }
    for name, (shape, items) in pictures.items():
        found += HALVED.cases(name, partial(_pictures, shape), items=items)
    return found


def _short(
    size: Sequence[int], channels: Sequence[int], outputs: int, how: dict[str, bool]
) -> Given:
    generator = torch.Generator().manual_seed(outputs)
    batch, height, width = size
    given = {
        "parts": [_signs(generator, (batch, count, height, width)) for count in channels],
        "weight": 24**2 * _signs(generator, (outputs, sum(channels), 3, 3), 0.5),
        "bias": _signs(generator, (outputs,), 1),
    }
    if how.get("plus"):
        given["plus"] = _signs(generator, (batch, outputs, height, width), 1)
    assert _largest(given).max() < 2**24, "numbers that are not short"
    kept = {name: how[name] for name in ("relu", "shuffle") if name in how}
    return given | kept | ({"spans": SPANS} if how.get("spans") else {})


def _long(size: Sequence[int], relu: bool = False) -> Given:
    """Without ReLU where gradients are compared: of a result near 0, it may pass one or not."""
    batch, height, width = size
    generator = torch.Generator().manual_seed(height)
    return {
        "parts": [_pictures((batch, CHANNELS, height, width))["pictures"]],
        "weight": uniform(generator, (CHANNELS, CHANNELS, 3, 3)),
        "bias": uniform(generator, (CHANNELS,)),
        "relu": relu,
    }


def _pictures(shape: Sequence[int]) -> Given:
    """Channels lie last."""
    batch, channels, height, width = shape
    generator = torch.Generator().manual_seed(height)
    return {"pictures": uniform(generator, (batch, height, width, channels)).permute(0, 3, 1, 2)}
