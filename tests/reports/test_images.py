"""The image of a frame: the right part enlarged, every run in it, nothing cut off."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from reports.images import (
    MOST_FRAMES,
    ComparedFrame,
    RunView,
    find_detail,
    frame_section,
    kept_frames,
    write_image,
)
from tests.reports.conftest import changed

HEIGHT, WIDTH = 64, 96


def flat(level: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), level, dtype=np.uint8)


def with_spot(top: int, left: int) -> np.ndarray:
    """A black picture with 4 x 4 white pixels."""
    picture = flat(0)
    picture[top : top + 4, left : left + 4] = 255
    return picture


@pytest.mark.parametrize(("top", "left"), [(30, 50), (0, 0), (60, 92)])
def test_the_detail_holds_what_differs_and_stays_within_the_picture(top, left):
    (x0, y0, x1, y1), where = find_detail(flat(255), [flat(0), with_spot(top, left)])
    assert 0 <= x0 <= left < left + 4 <= x1 <= WIDTH
    assert 0 <= y0 <= top < top + 4 <= y1 <= HEIGHT
    assert (x1 - x0, y1 - y0) == (WIDTH // 4, HEIGHT // 4)
    assert "renderings differ" in where


def test_of_one_rendering_the_detail_is_where_it_is_wrong_and_of_equal_ones_in_the_middle():
    box, where = find_detail(flat(0), [with_spot(30, 50)])
    assert box[0] <= 50 < box[2]
    assert "error" in where
    box, _ = find_detail(flat(9), [flat(0), flat(0)])
    assert (box[0] + box[2], box[1] + box[3]) == (WIDTH, HEIGHT)


@pytest.mark.parametrize(("runs", "columns", "lines"), [(1, 3, 2), (2, 3, 3), (4, 5, 3)])
def test_an_image_has_a_place_for_every_picture(tmp_path, runs, columns, lines):
    views = [RunView(("a", "b"), flat(50 * number), flat(7)) for number in range(runs)]
    frame = ComparedFrame("ball", "ball", flat(255), views, (0, 0, 24, 16), "they differ", "error")
    write_image(frame, tmp_path / "image.png")
    with Image.open(tmp_path / "image.png") as image:
        pixels = np.asarray(image)
    panel = (3 * HEIGHT, 3 * WIDTH)  # small pictures are enlarged by a whole number
    assert columns * panel[1] < pixels.shape[1] < (columns + 1) * panel[1]
    assert lines * panel[0] < pixels.shape[0] < (lines + 1) * panel[0]
    for number in range(runs):
        assert np.count_nonzero((pixels == 50 * number).all(axis=-1)) > panel[0] * panel[1]
    brightest = (pixels == [252, 254, 164]).all(axis=-1)  # of inferno: a scale beside several maps
    assert brightest.any() == (lines == 3)


def test_what_stands_below_a_picture_is_of_its_frame(run):
    frames = run.frames.assign(psnr=30.0 + np.arange(6), frame_ms=100.0 + np.arange(6))
    frames.loc[0, "phase"] = "cold"
    of_frames = replace(changed(run, {"frame_ms": 250.0}), read_frames=lambda: frames)
    kept = kept_frames([of_frames])
    parts = (part for frame in kept for part in frame_section([of_frames], frame, "frames"))
    titles = [
        view.titles[1] for part in parts if isinstance(part, ComparedFrame) for view in part.views
    ]
    assert titles[0] == "PSNR 30.00 dB, 100.0 ms, cold"
    assert titles[1:] == [f"PSNR {30 + int(frame):.2f} dB, 250.0 ms" for frame in kept[1:]]


def test_a_page_has_a_few_of_the_frames_that_all_runs_kept(tmp_path):
    runs = [SimpleNamespace(pictures=tmp_path / name) for name in ("many", "some")]
    for run, kept in zip(runs, (range(9), range(0, 9, 2)), strict=True):
        run.pictures.mkdir()
        for frame in kept:
            (run.pictures / f"{frame:04}-truth.png").touch()
    assert len(kept_frames(runs[:1])) == MOST_FRAMES == 3
    assert kept_frames(runs) == ["0000", "0004", "0008"]
