"""Area averaging: exact integers, colours weighed by their alpha, an exact camera."""

from __future__ import annotations

import io
from fractions import Fraction
from pathlib import Path

import pytest
import torch
from PIL import Image

from bench.scenes.images import MOST_PIXELS, decode_bytes, image_size, shrink
from bench.types import Camera, SteerbenchError

HERE = Path("picture.png")


def pinhole(width: int, height: int) -> Camera:
    c2w = torch.eye(4)[:3]
    return Camera(c2w, fx=10.0, fy=12.0, cx=width / 2, cy=height / 2, width=width, height=height)


def half_up(value: Fraction) -> int:
    return int((value + Fraction(1, 2)) // 1)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_shrink_is_the_exact_mean_weighted_by_alpha(factor) -> None:
    image = torch.randint(
        256, (11, 17, 4), dtype=torch.uint8, generator=torch.Generator().manual_seed(factor)
    )
    image[:factor, :factor, 3] = 0  # a block that nothing is seen in
    small, _ = shrink(image, pinhole(17, 11), factor, HERE)
    assert small.shape == (11 // factor, 17 // factor, 4)
    for row in range(small.shape[0]):
        for column in range(small.shape[1]):
            rows = slice(row * factor, (row + 1) * factor)
            columns = slice(column * factor, (column + 1) * factor)
            block = image[rows, columns].reshape(-1, 4).tolist()
            mass = sum(pixel[3] for pixel in block)
            expected = [
                half_up(Fraction(sum(p[c] * p[3] for p in block), mass)) if mass else 0
                for c in range(3)
            ]
            expected.append(half_up(Fraction(mass, factor**2)))
            assert small[row, column].tolist() == expected


def test_shrink_of_an_opaque_picture_is_the_mean() -> None:
    image = torch.tensor([[0, 1], [1, 1]], dtype=torch.uint8)[..., None].expand(2, 2, 3)
    assert shrink(image, pinhole(2, 2), 2, HERE)[0].tolist() == [[[1, 1, 1]]]


def test_what_fills_no_block_is_left_out_and_the_camera_stays_exact() -> None:
    image = torch.zeros(11, 17, 3, dtype=torch.uint8)
    _, camera = shrink(image, pinhole(17, 11), 4, HERE)
    assert (camera.width, camera.height) == (4, 2)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (2.5, 3.0, 17 / 8, 11 / 8)


@pytest.mark.parametrize(
    ("mode", "channels"), [("RGB", 3), ("RGBA", 4), ("L", 3), ("LA", 4), ("P", 3), ("1", 3)]
)
def test_every_8_bit_mode_becomes_rgb_or_rgba(mode, channels) -> None:
    buffer = io.BytesIO()
    Image.new(mode, (5, 4), 1 if mode in "1LP" else tuple(range(1, len(mode) + 1))).save(
        buffer, "png"
    )
    image = decode_bytes(buffer.getvalue(), HERE)
    assert image.dtype == torch.uint8
    assert image.shape == (4, 5, channels)


def test_a_palette_that_is_missing_is_named() -> None:
    buffer = io.BytesIO()
    Image.new("P", (5, 4)).save(buffer, "png")
    content = buffer.getvalue()
    chunk = content.index(b"PLTE") - 4  # its length, its name, colours, a checksum
    end = chunk + 12 + int.from_bytes(content[chunk : chunk + 4], "big")
    with pytest.raises(SteerbenchError, match="expected a palette beside numbers of colours"):
        decode_bytes(content[:chunk] + content[end:], HERE)


def test_a_header_that_announces_more_than_memory_holds_is_refused(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    Image.new("1", (1 << 14, (MOST_PIXELS >> 14) + 1)).save(buffer, "png")
    path = tmp_path / "large.png"
    path.write_bytes(buffer.getvalue())
    assert path.stat().st_size < 1 << 15
    for read in (lambda: image_size(path), lambda: decode_bytes(path.read_bytes(), path)):
        with pytest.raises(SteerbenchError, match="at most 67,108,864 pixels, got 16384 x 4097"):
            read()
