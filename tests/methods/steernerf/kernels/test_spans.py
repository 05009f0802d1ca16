"""Which pixels the spans of a picture hold."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from methods.steernerf.kernels.spans import RIM, Spans, ends, inside


def test_a_picture_cuts_the_last_unit_of_its_spans() -> None:
    """Of 6 x 9 pixels, in bands and units of 4."""
    spans = Spans(torch.tensor([[1, 2], [0, 3]]), 4)
    wanted = torch.zeros(6, 9, dtype=torch.bool)
    wanted[:4, 4:8] = wanted[4:] = True
    assert torch.equal(spans.mask(6, 9), wanted)
    assert spans.count(6, 9) == wanted.sum()
    assert ends(spans, 6, 9).tolist() == [[4, 8]] * 4 + [[0, 9]] * 2
    assert ends(None, 2, 9).tolist() == [[0, 9]] * 2


def test_a_span_may_be_empty_or_beyond_the_picture() -> None:
    spans = Spans(torch.tensor([[2, 2], [3, 1], [5, 7]]), 4)
    assert not spans.mask(12, 10).any()
    assert spans.count(12, 10) == 0


def test_a_smaller_picture_has_the_same_spans() -> None:
    spans = Spans(torch.tensor([[1, 2], [0, 3]]), 16)
    assert torch.equal(spans.at(4).mask(8, 9), spans.mask(32, 36)[::4, ::4])


@pytest.mark.parametrize(("bands", "unit"), [(1, 4), (2, 6)])
def test_too_few_bands_and_parts_of_tiles_are_refused(bands: int, unit: int) -> None:
    spans = Spans(torch.zeros(bands, 2, dtype=torch.int64), unit)
    with pytest.raises(ValueError, match=f"bands of 8 rows in all, got {bands} of {unit}"):
        ends(spans, 8, 8)


@pytest.mark.parametrize(
    ("size", "edges"),
    [
        ((48, 80), [False] * 4),
        ((48, 80), [True, False, False, True]),
        ((42, 75), [True] * 4),
    ],
)
def test_inside_is_what_has_computed_pixels_around_it_or_the_end_of_the_picture(
    size: tuple[int, int], edges: list[bool]
) -> None:
    """A mask made smaller by `RIM` pixels; bands of 16 rows, one of them empty."""
    for columns in ([[1, 4], [0, 5], [2, 5]], [[0, 5], [4, 2], [0, 5]]):
        spans = Spans(torch.tensor(columns), 16)
        top, bottom, left, right = edges
        beyond = functional.pad(spans.mask(*size).float(), [RIM] * 4)
        beyond[:RIM] = beyond[RIM] if top else 0
        beyond[-RIM:] = beyond[-RIM - 1] if bottom else 0
        beyond[:, :RIM] = beyond[:, RIM : RIM + 1] if left else 0
        beyond[:, -RIM:] = beyond[:, -RIM - 1 :][:, :1] if right else 0
        wanted = -functional.max_pool2d(-beyond[None], 2 * RIM + 1, 1)[0] == 1
        found = inside(spans, *size, edges).mask(*size)
        assert torch.equal(found, wanted)
