"""The page: complete, with pictures that are there, and never half-written."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import Image

from bench.types import SteerbenchError
from reports import figures
from reports.page import write_page


@pytest.fixture
def page(store, stored_run, tmp_path) -> Path:
    """The page of the one stored run."""
    return write_page(store, [stored_run], tmp_path / "page")


def linked(page: Path) -> list[Path]:
    """The pictures a page shows."""
    return [page.parent / name for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())]


def test_every_picture_on_the_page_lies_beside_it_and_can_be_read(page):
    pictures = linked(page)
    assert len(pictures) == 1 + 3 * 3  # the bar, then truth, rendering, error of three frames
    for path in pictures:
        Image.open(path).load()
    assert {path.resolve() for path in (page.parent / "pictures").iterdir()} == {
        path.resolve() for path in pictures
    }


def test_the_page_says_how_it_was_made_and_where_its_figures_come_from(page, stored_run):
    text = page.read_text()
    for fact in (
        "# offset on tiny",
        "```sh\nsteerbench run method=offset\n```",
        f"## Run {stored_run}",
        "| scene | tiny, digest 0123456789abcdef |",
        "| frames | test at 40x32 |",
        "| seed | 5 |",
        "lpips_alex: n/a. no weights were found",
        "absolute error, mean over the channels",
        "Python 3.",
    ):
        assert fact in text


def test_a_picture_of_a_cold_frame_says_so(store, stored_run, tmp_path):
    frames = store.frames(stored_run)
    frames.loc[0, "phase"] = "cold"
    frames.to_csv(store.folder / stored_run / "frames.csv", index=False)
    captions = re.findall(
        r"^\| (r_\d.*?) \|", write_page(store, [stored_run], tmp_path).read_text(), re.M
    )
    assert [caption.endswith(" dB, cold") for caption in captions] == [True, False, False]


def test_every_row_of_every_table_has_as_many_cells_as_its_heading(page):
    tables = re.findall(r"(?:^\|.*\|\n)+", page.read_text(), re.MULTILINE)
    assert len(tables) == 6
    for table in tables:
        assert len({line.count("|") for line in table.splitlines()}) == 1


def test_a_page_is_written_over_an_earlier_one_and_leaves_nothing_else(page, store, stored_run):
    before = {path: path.read_bytes() for path in page.parent.rglob("*") if path.is_file()}
    (page.parent / "pictures" / "run7-0042-truth.png").write_bytes(b"of an earlier page")
    write_page(store, [stored_run], page.parent)
    after = {path: path.read_bytes() for path in page.parent.rglob("*") if path.is_file()}
    assert after == before


def test_a_run_that_is_not_there_is_named(store, tmp_path):
    with pytest.raises(SteerbenchError, match="no run 'nonesuch'"):
        write_page(store, ["nonesuch"], tmp_path / "page")
    assert not (tmp_path / "page").exists()


def test_a_folder_that_cannot_be_written_is_named(store, stored_run, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(SteerbenchError, match="file"):
        write_page(store, [stored_run], tmp_path / "file" / "page")


@pytest.mark.parametrize("of", ["rows", "rows_with_cold"])
def test_a_bar_per_run_is_as_long_as_its_stages_together(of, request, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures.Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    figures.stage_bars(request.getfixturevalue(of), tmp_path / "bars.png")
    (axes,) = drawn[0].axes
    assert sum(bar.get_width() for bar in axes.patches) == 200.0
    assert axes.patches[1].get_x() == axes.patches[0].get_width() == 150.0
