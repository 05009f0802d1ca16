"""The page: complete, with pictures that are there, and never half-written."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pandas as pd
import pytest
from PIL import Image

from bench.types import SteerbenchError
from reports import figures, images
from reports.page import write_page
from reports.runs import Run


@pytest.fixture
def page(store, stored_run, tmp_path) -> Path:
    """The page of the one stored run."""
    return write_page(store, {stored_run: "offset"}, tmp_path / "page")


def linked(page: Path) -> list[Path]:
    """The pictures a page shows."""
    return [page.parent / name for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())]


def test_every_picture_on_the_page_lies_beside_it_and_can_be_read(page):
    pictures = linked(page)
    assert len(pictures) == 1 + 3  # the bar, then three frames
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
        f"## offset, run {stored_run}",
        "| scene | tiny, digest 0123456789abcdef |",
        "| frames | test at 40x32 |",
        "| seed | 5 |",
        "lpips_alex: n/a. no weights were found",
        "absolute error, mean over the channels",
        "Python 3.",
    ):
        assert fact in text


def test_a_picture_of_a_cold_frame_says_so(store, stored_run, tmp_path, monkeypatch):
    frames = store.frames(stored_run)
    frames.loc[0, "phase"] = "cold"
    frames.to_csv(store.folder / stored_run / "frames.csv", index=False)
    titles = []

    write_image = images.write_image

    def note_titles(truth, views, *rest):
        titles.extend(views[0].titles[1:])
        write_image(truth, views, *rest)

    monkeypatch.setattr(images, "write_image", note_titles)
    write_page(store, {stored_run: "offset"}, tmp_path)
    assert [title.endswith(" ms, cold") for title in titles] == [True, False, False]


def test_a_page_is_written_over_an_earlier_one_and_leaves_nothing_else(page, store, stored_run):
    before = {path: path.read_bytes() for path in page.parent.rglob("*") if path.is_file()}
    (page.parent / "pictures" / "frames-7-0042-0-0123456789ab.png").write_bytes(
        b"of an earlier page"
    )
    write_page(store, {stored_run: "offset"}, page.parent)
    after = {path: path.read_bytes() for path in page.parent.rglob("*") if path.is_file()}
    assert after == before


def test_an_interrupted_page_leaves_the_earlier_one_with_its_pictures(page, several, monkeypatch):
    before = {path: path.read_bytes() for path in linked(page)}

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("reports.publish.html_page", killed)
        with pytest.raises(KeyboardInterrupt):
            write_page(*several, page.parent)
    assert {path: path.read_bytes() for path in linked(page)} == before
    write_page(*several, page.parent)
    assert set((page.parent / "pictures").iterdir()) == set(linked(page))


def test_a_run_that_is_not_there_is_named(store, tmp_path):
    with pytest.raises(SteerbenchError, match="no run 'nonesuch'"):
        write_page(store, {"nonesuch": "none"}, tmp_path / "page")
    assert not (tmp_path / "page").exists()


def test_a_page_of_several_runs_has_all_of_them_beside_each_other(several, tmp_path):
    store, labels = several
    page = write_page(store, labels, tmp_path / "page", {"gone": "no memory"})
    text = page.read_text()
    assert text.startswith("# 6 runs on tiny\n")
    plots, frames = linked(page)[:3], linked(page)[3:]
    assert [path.stem[:-13] for path in plots] == ["psnr-ms", "psnr-bytes", "stages"]
    assert len(frames) == 3 * 2  # at most four runs in each
    firsts = {path.stem.split("-")[-2] for path in frames}
    assert firsts == {"0", "3"}  # and as many in either
    assert {path.resolve() for path in (page.parent / "pictures").iterdir()} == {
        path.resolve() for path in linked(page)
    }
    assert "gone: failed: no memory" in text
    for key, label in labels.items():
        assert f"\n| {label} |" in text
        assert f"## {label}, run {key}" in text
        assert f"| run, {label} | {key} |" in text


def test_provenance_lists_once_what_all_runs_have_in_common(several, tmp_path):
    text = write_page(*several, tmp_path / "page").read_text()
    assert text.count("steerbench run method=offset") == 1
    assert text.count("| seed | 5 |") == 1
    assert "| machine, copy 4 | another," in text


def test_quality_is_plotted_against_cost_only_where_two_runs_have_both(several, tmp_path):
    store, labels = several
    key, other = list(labels)[:2]
    rows = pd.read_csv(store.folder / other / "rows.csv")
    rows.loc[rows["metric"] == "size_bytes.total", "value"] = float("nan")
    rows.to_csv(store.folder / other / "rows.csv", index=False)
    text = write_page(store, {key: "one", other: "two"}, tmp_path / "page").read_text()
    assert "## Quality against time" in text
    assert "## Quality against memory" not in text


def test_runs_of_different_frames_are_not_put_into_one_picture(several, tmp_path):
    store, labels = several
    key, other = list(labels)[:2]
    record = json.loads((store.folder / other / "record.json").read_text())
    record["scene"]["digest"] = "of another scene"
    (store.folder / other / "record.json").write_text(json.dumps(record))
    page = write_page(store, {key: "one", other: "two"}, tmp_path / "page")
    assert len(linked(page)) == 3 + 2 * 3
    assert "**" not in page.read_text()


@pytest.mark.parametrize("of", ["rows", "rows_with_cold"])
def test_a_bar_per_run_is_as_long_as_its_stages_together(of, request, tmp_path, drawn):
    rows = request.getfixturevalue(of)
    other = rows[rows["metric"] != "stage_ms.other"]
    runs = [
        Run(str(i), f"run {i}", r, pd.DataFrame, {}, tmp_path) for i, r in enumerate((rows, other))
    ]
    figures.stage_bars(runs, tmp_path / "bars.png")
    (axes,) = drawn[0].axes
    field, rest = axes.containers
    assert [bar.get_width() for bar in field] == [150.0, 150.0]
    assert [bar.get_width() for bar in rest] == [50.0, 0.0]
    assert [bar.get_x() for bar in rest] == [150.0, 150.0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["run 0", "run 1"]
