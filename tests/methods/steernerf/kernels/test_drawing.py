"""What the network is shown and the picture that it corrects, against plain loops, closed forms and
finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from methods.steernerf.kernels.drawing import corrected, shown

BACKENDS = ["reference", "cpu"]
HEIGHT, WIDTH, SCALE, FEATURES = 2, 3, 4, 5


def features(preceding: int = 2, dtype: torch.dtype = torch.float32) -> tuple[Tensor, ...]:
    """Of the present frame and of 20 points, and the points that pixels show."""
    generator = torch.Generator().manual_seed(preceding)
    present = torch.rand(HEIGHT, WIDTH, FEATURES, generator=generator, dtype=dtype)
    values = torch.rand(20, FEATURES, generator=generator, dtype=dtype)
    shape = preceding, HEIGHT * SCALE, WIDTH * SCALE
    index = torch.randint(-1, 20, shape, generator=generator, dtype=torch.int32)
    return present, values, index


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("frames", [2, 3])
def test_a_pixel_has_the_features_of_its_points_and_every_fourth_the_present_ones(
    frames: int, backend: str
) -> None:
    """Frame by frame, in Python; with L = 3 one frame is missing."""
    present, values, index = features()
    values[0] = torch.nan  # stays in the pixels that show it
    got = shown(present, values, index, frames, backend=backend)
    assert got.shape == (HEIGHT * SCALE, WIDTH * SCALE, FEATURES * (frames + 1))
    nothing = torch.zeros(FEATURES)
    for row in range(got.shape[0]):
        for column in range(got.shape[1]):
            here = row % SCALE == column % SCALE == 0
            of_each = [present[row // SCALE, column // SCALE] if here else nothing]
            of_each += [values[i] if i >= 0 else nothing for i in index[:, row, column].tolist()]
            of_each += [nothing] * (frames - 2)
            want = torch.cat([x[:3] for x in of_each] + [x[3:] for x in of_each])
            assert torch.equal(got[row, column].nan_to_num(2.0), want.nan_to_num(2.0))


@pytest.mark.parametrize("backend", BACKENDS)
def test_features_of_16_bits_are_rounded_before_they_are_moved(backend: str) -> None:
    given = features()
    got = shown(*given, 2, dtype=torch.bfloat16, backend=backend)
    assert got.dtype == torch.bfloat16
    assert torch.equal(got, shown(*given, 2, backend=backend).bfloat16())


def test_memory_is_used_where_it_has_room_and_nothing_needs_a_gradient() -> None:
    """What lay there before does not show."""
    given = features()
    want = shown(*given, 2, backend="cpu")
    for size, used in ((want.numel() + 5, True), (want.numel() - 1, False)):
        memory = torch.full((size,), torch.nan)
        got = shown(*given, 2, memory=memory, backend="cpu")
        assert torch.equal(got, want)
        assert (got.data_ptr() == memory.data_ptr()) == used
    learnt = shown(given[0].requires_grad_(), *given[1:], 2, memory=memory, backend="cpu")
    assert learnt.data_ptr() != memory.data_ptr()


def test_gradients_of_what_is_shown_in_float64() -> None:
    present, values, index = features(dtype=torch.float64)
    given = present.requires_grad_(), values.requires_grad_()
    assert torch.autograd.gradcheck(lambda *x: shown(*x, index, 3, backend="reference"), given)


@pytest.mark.parametrize("aligned", [True, False])
def test_gradients_of_a_picture_in_float64(aligned: bool) -> None:
    rgb = torch.rand(2, 3, 3, dtype=torch.float64, requires_grad=True)
    correction = torch.rand(5, 4, 3, dtype=torch.float64, requires_grad=True)

    def picture(*given: Tensor) -> Tensor:
        return corrected(*given, (1, 6), SCALE, aligned, backend="reference")

    assert torch.autograd.gradcheck(picture, (rgb, correction))


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_clipped_picture_is_within_0_and_1_and_hides_nothing_that_is_not_finite(
    backend: str,
) -> None:
    rgb, correction = torch.full((1, 1, 3), 0.5), torch.tensor([[[-1.0, 1.0, torch.nan]]])
    got = corrected(rgb, correction, (0, 0), 1, True, clip=True, backend=backend)
    assert got[0, 0, :2].tolist() == [0, 1]
    assert got[0, 0, 2].isnan()


def test_wrong_arguments_are_named() -> None:
    present, values, index = features()
    with pytest.raises(ValueError, match=r"values: expected shape \[any, 5\], got \[20, 4\]"):
        shown(present, values[:, :4], index, 2)
    with pytest.raises(ValueError, match=r"index: expected shape \[any, any, any\]"):
        shown(present, values, index[0], 2)
    with pytest.raises(ValueError, match=r"correction: expected shape \[any, any, 3\]"):
        corrected(present[..., :3], values, (0, 0), SCALE, True)
