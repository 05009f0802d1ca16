"""Area averaging, exact and weighed by alpha; pictures decoded when they are asked for."""

import io
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from bench.scenes import images
from bench.scenes.assemble import describe_splits
from bench.scenes.images import (
    MOST_PIXELS,
    Pictures,
    View,
    decode_bytes,
    describe,
    image_size,
    shrink,
    shrunk_camera,
)
from bench.types import Camera
from tests.bench.scenes.conftest import encoded, intrinsics, picture
from tests.common import refusal

HERE = Path("picture.png")


def pinhole(width: int, height: int) -> Camera:
    c2w = torch.eye(4)[:3]
    return Camera(c2w, fx=10.0, fy=12.0, cx=width / 2, cy=height / 2, width=width, height=height)


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_shrink_is_the_exact_mean_weighted_by_alpha(factor):
    """In whole numbers; halves are rounded up."""
    image = torch.from_numpy(picture(factor, 17, 11))
    image[:factor, :factor, 3] = 0  # a block that nothing is seen in
    rows = 11 // factor
    columns = 17 // factor
    whole = image[: rows * factor, : columns * factor].long()
    blocks = whole.view(rows, factor, columns, factor, 4)
    colours, alphas = blocks.split([3, 1], dim=4)
    mass = alphas.sum((1, 3))
    total = (colours * alphas).sum((1, 3))
    means = (2 * total + mass) // (2 * mass).clamp(min=1)
    alpha = (2 * mass + factor**2) // (2 * factor**2)
    small = shrink(image, factor)
    assert torch.equal(small[..., :3].long(), means)
    assert torch.equal(small[..., 3:].long(), alpha)


def test_what_fills_no_block_is_left_out_and_the_camera_stays_exact():
    image = torch.tensor([[0, 1], [1, 1]], dtype=torch.uint8)[..., None].expand(2, 2, 3)
    assert shrink(image, 2).tolist() == [[[1, 1, 1]]]  # the mean of an opaque picture
    assert shrink(torch.zeros(11, 17, 3, dtype=torch.uint8), 4).shape == (2, 4, 3)
    camera = shrunk_camera(pinhole(17, 11), 4, HERE)
    assert (camera.width, camera.height) == (4, 2)
    assert intrinsics(camera) == (2.5, 3.0, 17 / 8, 11 / 8)


@pytest.mark.parametrize(
    ("mode", "channels"),
    [("RGB", 3), ("RGBA", 4), ("L", 3), ("LA", 4), ("P", 3), ("1", 3), ("CMYK", 3)],
)
def test_every_8_bit_mode_becomes_rgb_or_rgba(mode, channels):
    colour = 1 if mode in "1LP" else tuple(range(1, len(mode) + 1))
    kind = "TIFF" if mode == "CMYK" else "PNG"
    image = decode_bytes(encoded(mode, kind, size=(5, 4), colour=colour), HERE)
    assert image.dtype == torch.uint8
    assert image.shape == (4, 5, channels)


def with_orientation(stored: Image.Image, number: int) -> bytes:
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x112] = number
    stored.save(file, "PNG", exif=exif)
    return file.getvalue()


@pytest.mark.parametrize(
    ("number", "back"), [(1, None), (2, 0), (3, 3), (4, 1), (5, 5), (6, 2), (7, 6), (8, 4)]
)
def test_a_picture_is_turned_as_viewers_show_it(number, back):
    upright = Image.fromarray(picture(0, 5, 4, 3))
    stored = upright if back is None else upright.transpose(back)
    found = decode_bytes(with_orientation(stored, number), HERE)
    assert np.array_equal(found.numpy(), picture(0, 5, 4, 3))


@pytest.mark.parametrize(
    ("size", "number", "of_camera", "colmap", "said"),
    [
        ((5, 4), 6, (5, 4), False, "1 pictures are not turned"),
        ((5, 4), 6, (4, 5), False, "1 pictures are turned"),
        ((5, 5), 6, (5, 5), True, "1 pictures are not turned"),
        ((5, 4), 3, (5, 4), False, "got EXIF orientation 3"),
    ],
)
def test_the_camera_says_whether_its_picture_is_turned(
    size, number, of_camera, colmap, said, tmp_path, log
):
    path, image = tmp_path / "a.png", Image.fromarray(picture(0, *size, 3))
    path.write_bytes(with_orientation(image, number))
    view = View("a.png", path, pinhole(*of_camera), stored=colmap)
    if "got" in said:
        with refusal(f"a.png: .* {said}"):
            describe_splits({"": [view]}, 1, log)
        return
    pixels = describe_splits({"": [view]}, 1, log)[""][0]
    turned = image if "not" in said else image.transpose(Image.Transpose.ROTATE_270)
    assert np.array_equal(pixels.numpy(), np.array(turned))
    assert said in log.messages[0]
    assert image_size(path, like=of_camera) == of_camera


def animation() -> bytes:
    file, frames = io.BytesIO(), [Image.new("RGB", (5, 4), (k, k, k)) for k in (0, 90)]
    frames[0].save(file, "WEBP", save_all=True, append_images=frames[1:], lossless=True)
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "name", "said"),
    [
        (encoded("F", "TIFF"), "a.tif", "8 bits a channel, got floats"),
        (encoded("I;16"), "a.png", "8 bits a channel, got 16"),
        (animation(), "a.webp", "one picture, got several: an animation"),
        (b"v/1\x01" + bytes(40), "a.exr", r"such as PNG, got one that Pillow .* \(.exr\)$"),
    ],
)
def test_other_pictures_are_refused_by_what_they_are(content, name, said):
    with refusal(f"{name}: expected .*{said}"):
        decode_bytes(content, Path(name))


def test_a_palette_that_is_missing_is_named():
    content = encoded("P")
    chunk = content.index(b"PLTE") - 4  # its length, its name, colours, a checksum
    end = chunk + 12 + int.from_bytes(content[chunk : chunk + 4], "big")
    with refusal("expected a palette beside numbers of colours"):
        decode_bytes(content[:chunk] + content[end:], HERE)


def test_a_header_that_announces_more_than_memory_holds_is_refused(tmp_path):
    path = tmp_path / "large.png"
    path.write_bytes(encoded("1", size=(1 << 14, (MOST_PIXELS >> 14) + 1)))
    assert path.stat().st_size < 1 << 15
    for read in (lambda: image_size(path), lambda: decode_bytes(path.read_bytes(), path)):
        with refusal("at most 67,108,864 pixels, got 16384 x 4097"):
            read()


@pytest.fixture
def files(tmp_path) -> list[Path]:
    """Four pictures of 5 x 4 in files."""
    paths = [tmp_path / f"{number}.png" for number in range(4)]
    for number, path in enumerate(paths):
        Image.fromarray(picture(number, 5, 4)).save(path)
    return paths


def pictures(files: list[Path], log) -> Pictures:
    views = [View(path.name, path, pinhole(5, 4)) for path in files]
    return Pictures([describe(view, 1) for view in views], log)


def test_only_pictures_that_are_asked_for_are_decoded_and_once(files, log, monkeypatch):
    opened = []

    def decode(picture):
        opened.append(picture.view.name)
        return images.decode_bytes(picture.view.path.read_bytes(), picture.view.path)

    monkeypatch.setattr(images, "decode", decode)
    lazy = pictures(files, log)
    assert len(lazy) == 4
    assert opened == []
    last = lazy[-1]
    assert opened == ["3.png"]
    assert list(lazy)[3] is last
    assert lazy[1:3][0] is lazy[1]
    assert sorted(opened) == ["0.png", "1.png", "2.png", "3.png"]


def test_threads_that_ask_for_pictures_at_once_get_them_in_order(files, log):
    expected = [decode_bytes(path.read_bytes(), path) for path in files]
    lazy = pictures(files, log)
    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(list, [lazy] * 8):
            assert all(map(torch.equal, found, expected))


def test_files_that_were_damaged_or_change_before_they_are_decoded_are_refused(files, log):
    files[1].write_bytes(files[1].read_bytes()[:-40])
    lazy = pictures(files, log)
    files[2].write_bytes(files[2].read_bytes() + b" ")
    files[3].unlink()
    assert lazy[0].shape == (4, 5, 4)
    for index, message in (
        (1, "a whole picture"),
        (2, "the picture that was there at the start, got another"),
        (3, "a picture, got no"),
    ):
        with refusal(rf"{index}\.png: expected {message}"):
            lazy[index]
